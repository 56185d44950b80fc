//! Spaces as messages: [`to_message`] and [`from_message`].

use crate::v1::space::Kind;
use crate::v1::{self, Composition};
use std::f64::consts::TAU;
use thiserror::Error;
use wayfold_index::{Factor, Group, Space, SpaceError, Term};

/// The error of a message that is not a space. Its text begins with the path of the field, as in
/// `product.terms[2].space: not set`.
#[derive(Clone, Debug, PartialEq, Error)]
#[error("{path}: {problem}")]
pub struct SpaceMessageError {
    /// The field, from the `Space` message: `product.terms[2].space`.
    pub path: String,
    /// The problem with it.
    pub problem: SpaceMessageProblem,
}

/// A problem with a field of a space's message.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum SpaceMessageProblem {
    /// A term without a space.
    #[error("not set")]
    NoSpace,
    /// A space without a kind.
    #[error("not set; set one of real_vector, so2, so3 and product")]
    NoKind,
    /// A composition that is unspecified, or a number that names none.
    #[error("unspecified or unknown ({0}); set COMPOSITION_L2 (1) or COMPOSITION_SUM (2)")]
    Composition(i32),
    /// A product without terms.
    #[error("empty; a product has at least one term")]
    NoTerms,
    /// A sum within a product.
    #[error("a SUM product within a product; a SUM stands outermost, nothing deeper is accepted")]
    TooDeep,
    /// A weight that is negative, infinite or NaN.
    #[error("{0:?}; weights are finite and at least 0")]
    Weight(f64),
    /// A factor, or the space as a whole, that the index refuses.
    #[error(transparent)]
    Space(SpaceError),
}

impl SpaceMessageError {
    fn new(path: &str, problem: SpaceMessageProblem) -> SpaceMessageError {
        let path = path.to_owned();
        SpaceMessageError { path, problem }
    }

    /// The same error with a longer path: the erroneous space is that of the term `index` of a product.
    fn in_term(self, term: usize) -> SpaceMessageError {
        SpaceMessageError {
            path: format!("product.terms[{term}].space.{}", self.path),
            ..self
        }
    }
}

/// The message of a space, expanded: an L2 product if it is one group of weight 1, or else a SUM of such. A group of a
/// single factor of weight 1 is that factor.
pub fn to_message(space: &Space) -> v1::Space {
    if let [group @ Group { weight: 1.0, .. }] = space.groups() {
        return group_message(group);
    }
    let terms = space.groups().iter();
    product_message(
        Composition::Sum,
        terms.map(|group| (group_message(group), group.weight)),
    )
}

fn group_message(group: &Group) -> v1::Space {
    if let [
        Term {
            factor,
            weight: 1.0,
        },
    ] = group.terms[..]
    {
        return factor_message(factor);
    }
    let terms = group.terms.iter();
    product_message(
        Composition::L2,
        terms.map(|term| (factor_message(term.factor), term.weight)),
    )
}

fn product_message(
    composition: Composition,
    terms: impl Iterator<Item = (v1::Space, f64)>,
) -> v1::Space {
    let terms = terms.map(|(space, weight)| v1::Term {
        space: Some(space),
        weight: (weight != 1.0).then_some(weight),
    });
    v1::Space {
        kind: Some(Kind::Product(v1::Product {
            composition: composition.into(),
            terms: terms.collect(),
        })),
    }
}

fn factor_message(factor: Factor) -> v1::Space {
    let kind = match factor {
        Factor::RealVector(n) => Kind::RealVector(v1::RealVector {
            // A space has at most 256 coordinates.
            dimensions: n as u32,
        }),
        Factor::SO2 { period } => Kind::So2(v1::So2 {
            period: (period != TAU).then_some(period),
        }),
        Factor::SO3 => Kind::So3(v1::So3 {}),
    };
    v1::Space { kind: Some(kind) }
}

/// The space of a message: a factor, an L2 product of factors and L2 products, or a SUM of these.
///
/// An L2 product within another is expanded, its weight multiplying those of its terms. The recursion is as deep as
/// the message, whose depth its decoder bounds.
///
/// # Errors
/// A kind, a term's space or a composition is not set, a product is empty, a SUM is not outermost, or the space is not
/// valid: a dimension of 0, a period or weight out of range, no weight above 0, or too many coordinates.
pub fn from_message(message: &v1::Space) -> Result<Space, SpaceMessageError> {
    let (groups, root) = match kind(message)? {
        Kind::Product(product) if composition(product)? == Composition::Sum => {
            (sum_groups(product)?, "product")
        }
        Kind::Product(_) => (vec![group(message, 1.0)?], "product"),
        Kind::RealVector(_) => (vec![group(message, 1.0)?], "real_vector"),
        Kind::So2(_) => (vec![group(message, 1.0)?], "so2"),
        Kind::So3(_) => (vec![group(message, 1.0)?], "so3"),
    };
    Space::new(groups)
        .map_err(|error| SpaceMessageError::new(root, SpaceMessageProblem::Space(error)))
}

fn sum_groups(product: &v1::Product) -> Result<Vec<Group>, SpaceMessageError> {
    bounded(product.terms.len())?;
    let mut groups = Vec::with_capacity(product.terms.len());
    for (i, term) in product.terms.iter().enumerate() {
        let (space, weight) = term_parts(term, i)?;
        groups.push(group(space, weight).map_err(|error| error.in_term(i))?);
    }
    Ok(groups)
}

fn group(message: &v1::Space, weight: f64) -> Result<Group, SpaceMessageError> {
    let mut terms = Vec::new();
    expand(message, 1.0, &mut terms)?;
    Ok(Group { weight, terms })
}

/// Every term has a coordinate at least, so that a message of too many is refused before it is expanded.
fn bounded(terms: usize) -> Result<(), SpaceMessageError> {
    if terms <= Space::MAX_COORDINATES {
        return Ok(());
    }
    let problem = SpaceMessageProblem::Space(SpaceError::TooManyCoordinates);
    Err(SpaceMessageError::new("product.terms", problem))
}

/// Adds the factors of a factor or an L2 product to `terms`, their weights times `weight`.
fn expand(
    message: &v1::Space,
    weight: f64,
    terms: &mut Vec<Term>,
) -> Result<(), SpaceMessageError> {
    let factor = match kind(message)? {
        Kind::Product(product) => {
            if composition(product)? == Composition::Sum {
                return Err(SpaceMessageError::new(
                    "product.composition",
                    SpaceMessageProblem::TooDeep,
                ));
            }
            bounded(terms.len() + product.terms.len())?;
            for (i, term) in product.terms.iter().enumerate() {
                let (space, own) = term_parts(term, i)?;
                expand(space, weight * own, terms).map_err(|error| error.in_term(i))?;
            }
            return Ok(());
        }
        Kind::RealVector(vector) => valid(
            Factor::RealVector(vector.dimensions as usize),
            "real_vector.dimensions",
        )?,
        Kind::So2(circle) => {
            let period = circle.period.unwrap_or(TAU);
            valid(Factor::SO2 { period }, "so2.period")?
        }
        Kind::So3(_) => Factor::SO3,
    };
    terms.push(Term { factor, weight });
    Ok(())
}

/// Returns the factor, if a space may consist of it. The check is here because the field is known here.
fn valid(factor: Factor, path: &str) -> Result<Factor, SpaceMessageError> {
    match Space::product(vec![factor.into()]) {
        Ok(_) => Ok(factor),
        Err(error) => Err(SpaceMessageError::new(
            path,
            SpaceMessageProblem::Space(error),
        )),
    }
}

fn kind(message: &v1::Space) -> Result<&Kind, SpaceMessageError> {
    let missing = || SpaceMessageError::new("kind", SpaceMessageProblem::NoKind);
    message.kind.as_ref().ok_or_else(missing)
}

/// The composition of a product that has one, and terms.
fn composition(product: &v1::Product) -> Result<Composition, SpaceMessageError> {
    if product.terms.is_empty() {
        return Err(SpaceMessageError::new(
            "product.terms",
            SpaceMessageProblem::NoTerms,
        ));
    }
    match Composition::try_from(product.composition) {
        Ok(composition @ (Composition::L2 | Composition::Sum)) => Ok(composition),
        Ok(Composition::Unspecified) | Err(_) => Err(SpaceMessageError::new(
            "product.composition",
            SpaceMessageProblem::Composition(product.composition),
        )),
    }
}

/// The space and the weight of the term of this index.
fn term_parts(term: &v1::Term, index: usize) -> Result<(&v1::Space, f64), SpaceMessageError> {
    let fail = |field, problem| {
        let path = format!("product.terms[{index}].{field}");
        Err(SpaceMessageError { path, problem })
    };
    let weight = term.weight.unwrap_or(1.0);
    if !(weight.is_finite() && weight >= 0.0) {
        return fail("weight", SpaceMessageProblem::Weight(weight));
    }
    match &term.space {
        Some(space) => Ok((space, weight)),
        None => fail("space", SpaceMessageProblem::NoSpace),
    }
}
