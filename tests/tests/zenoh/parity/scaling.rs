//! Scaled numbers and radii, right and wrong, in place of the fixed ones of operations.

use rand::{RngExt, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1::{self, neighbor_spec};

use super::op::Op;

/// Scales the numbers and radii of some operations.
pub(super) fn scale(op: &mut Op, random: &mut ChaCha8Rng) {
    if !random.random_bool(0.4) {
        return;
    }
    let (k_factor, radius) = draw(random);
    let count = k_factor.map(neighbor_spec::KForm::KFactor);
    let radius_form = radius.map(neighbor_spec::RadiusForm::ScaledRadius);
    match op {
        Op::Insert(v1::InsertRequest {
            neighbor_spec: Some(it),
            ..
        }) => {
            it.k_form = count.or(it.k_form);
            it.radius_form = radius_form.or(it.radius_form);
        }
        Op::Knn(it) => {
            it.k_form = count.map(Into::into).or(it.k_form);
            it.radius_form = radius_form.map(Into::into).or(it.radius_form);
        }
        Op::Query(it) => it.radius_form = radius_form.map(Into::into).or(it.radius_form),
        _ => {}
    }
}

/// A factor of the number, and a radius; at least one of them. One in three is wrong in some way.
fn draw(random: &mut ChaCha8Rng) -> (Option<f64>, Option<v1::ScaledRadius>) {
    let is_wrong = random.random_bool(0.35);
    let mut pick = |of: &[Option<f64>]| *of.choose(random).unwrap();
    let (k_factor, factor, max) = if is_wrong {
        (
            pick(&[None, Some(-1.0), Some(f64::INFINITY), Some(1e9)]),
            pick(&[Some(f64::NAN), Some(2.0)]),
            pick(&[None, Some(0.4), Some(-0.5)]),
        )
    } else {
        let (k_factor, factor) = match pick(&[None, Some(0.0), Some(1.5), Some(5.4)]) {
            None => (None, pick(&[Some(0.5), Some(2.0)])),
            k_factor => (k_factor, pick(&[None, Some(2.0)])),
        };
        (
            k_factor,
            factor,
            pick(&[None, Some(0.4), Some(f64::INFINITY)]),
        )
    };
    let radius = factor.map(|factor| v1::ScaledRadius { factor, max });
    (k_factor, radius)
}

/// True if it asks for scaled numbers or radii.
pub(super) fn is_scaled(op: &Op) -> bool {
    let (count, radius_form): (
        Option<neighbor_spec::KForm>,
        Option<neighbor_spec::RadiusForm>,
    ) = match op {
        Op::Insert(it) => it
            .neighbor_spec
            .as_ref()
            .map_or((None, None), |it| (it.k_form, it.radius_form)),
        Op::Knn(it) => (it.k_form.map(Into::into), it.radius_form.map(Into::into)),
        Op::Query(it) => (None, it.radius_form.map(Into::into)),
        _ => (None, None),
    };
    matches!(count, Some(neighbor_spec::KForm::KFactor(_)))
        || matches!(
            radius_form,
            Some(neighbor_spec::RadiusForm::ScaledRadius(_))
        )
}
