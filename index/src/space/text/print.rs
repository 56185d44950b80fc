//! Prints the canonical text form: expanded, then folded where it repeats.

use crate::space::{Factor, Group, Space, Term};
use std::f64::consts::TAU;
use std::fmt;

/// Prints a whole space.
pub(in crate::space) fn print(space: &Space, f: &mut fmt::Formatter<'_>) -> fmt::Result {
    let groups = space.groups();
    if let [Group { weight: 1.0, terms }] = groups {
        return f.write_str(&fold(terms).join("*"));
    }
    let arguments: Vec<String> = groups
        .chunk_by(|a, b| a == b)
        .map(|run| argument(&run[0], run.len()))
        .collect();
    write!(f, "sum({})", arguments.join(", "))
}

/// `count` equal groups, as an argument of a sum.
fn argument(group: &Group, count: usize) -> String {
    let decorations = format!("{}{}", Weight(group.weight), Count(count));
    if let [
        Term {
            factor,
            weight: 1.0,
        },
    ] = group.terms[..]
    {
        return format!("{}{decorations}", Name(factor));
    }
    let items = fold(&group.terms);
    if items.len() > 1 && decorations.is_empty() {
        return items.join("*");
    }
    format!("({}){decorations}", items.join("*"))
}

/// The items of a product of these terms. The function folds the repeating block whose repetitions extend farthest, and
/// the shortest one if several do. It folds the block itself in the same way.
fn fold(terms: &[Term]) -> Vec<String> {
    let (mut items, mut rest) = (Vec::new(), terms);
    while !rest.is_empty() {
        let (mut length, mut count) = (1, 1);
        for candidate in 1..=rest.len() / 2 {
            let block = &rest[..candidate];
            let repeated = rest.chunks(candidate).take_while(|c| *c == block).count();
            if repeated > 1 && repeated * candidate > length * count {
                (length, count) = (candidate, repeated);
            }
        }
        items.push(match &rest[..length] {
            [term] => format!(
                "{}{}{}",
                Name(term.factor),
                Weight(term.weight),
                Count(count)
            ),
            block => format!("({}){}", fold(block).join("*"), Count(count)),
        });
        rest = &rest[length * count..];
    }
    items
}

/// Prints as a factor: `R3`, `SO2`, `SO2[1]`, `SO3`.
struct Name(Factor);

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Factor::RealVector(n) => write!(f, "R{n}"),
            Factor::SO2 { period: TAU } => f.write_str("SO2"),
            Factor::SO2 { period } => write!(f, "SO2[{}]", Number(period)),
            Factor::SO3 => f.write_str("SO3"),
        }
    }
}

/// Prints as `:0.15`, or as nothing where it is 1.
struct Weight(f64);

impl fmt::Display for Weight {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            1.0 => Ok(()),
            weight => write!(f, ":{}", Number(weight)),
        }
    }
}

/// Prints as `^8`, or as nothing where it is 1.
struct Count(usize);

impl fmt::Display for Count {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            1 => Ok(()),
            count => write!(f, "^{count}"),
        }
    }
}

/// Prints a number above or equal to 0 with the fewest digits that are read as the same bits.
struct Number(f64);

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0 == 0.0 || (1e-5..1e15).contains(&self.0) {
            write!(f, "{}", self.0)
        } else {
            write!(f, "{:e}", self.0)
        }
    }
}
