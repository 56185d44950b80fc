//! Numbers and radii by the size of the index, right and wrong, in the place of those that operations have.

use rand::{RngExt, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1;

use super::script::Op;

/// Scales what some operations ask for. Now and then what was fixed stays beside it, or a Query gets a number.
pub(super) fn scale(op: &mut Op, random: &mut ChaCha8Rng) {
    if !random.random_bool(0.4) {
        return;
    }
    let scaling = draw(random);
    let keeps = random.random_bool(0.1);
    let scales_k = scaling.k_factor.is_some() && !keeps;
    let scales_radius = scaling.radius_factor.is_some() && !keeps;
    match op {
        Op::Insert(v1::InsertRequest {
            neighbors: Some(it),
            ..
        }) => {
            it.scaling = Some(scaling);
            it.k = it.k.filter(|_| !scales_k);
            it.radius = it.radius.filter(|_| !scales_radius);
        }
        Op::Knn(it) => {
            it.scaling = Some(scaling);
            it.k = if scales_k { 0 } else { it.k };
            it.radius = it.radius.filter(|_| !scales_radius);
        }
        Op::Query(it) => {
            it.scaling = Some(v1::Scaling {
                k_factor: scaling.k_factor.filter(|_| keeps),
                ..scaling
            });
            it.radius = it.radius.filter(|_| !scales_radius);
        }
        _ => {}
    }
}

/// One in four is wrong in some way.
fn draw(random: &mut ChaCha8Rng) -> v1::Scaling {
    let is_wrong = random.random_bool(0.25);
    let mut pick = |of: &[Option<f64>]| *of.choose(random).unwrap();
    if is_wrong {
        return v1::Scaling {
            k_factor: pick(&[None, Some(-1.0), Some(f64::INFINITY), Some(1e9)]),
            radius_factor: pick(&[None, Some(f64::NAN), Some(2.0)]),
            radius_max: pick(&[None, Some(0.4), Some(-0.5)]),
        };
    }
    let (k_factor, radius_factor) = match pick(&[None, Some(0.0), Some(1.5), Some(5.4)]) {
        None => (None, pick(&[Some(0.5), Some(2.0)])),
        k_factor => (k_factor, pick(&[None, Some(2.0)])),
    };
    let radius_max = pick(&[None, Some(0.4), Some(f64::INFINITY)]);
    v1::Scaling {
        k_factor,
        radius_factor,
        radius_max: radius_max.filter(|_| radius_factor.is_some()),
    }
}

/// Whether it asks for numbers or radii by the size of the index.
pub(super) fn is_scaled(op: &Op) -> bool {
    match op {
        Op::Insert(it) => it.neighbors.is_some_and(|it| it.scaling.is_some()),
        Op::Knn(it) => it.scaling.is_some(),
        Op::Query(it) => it.scaling.is_some(),
        _ => false,
    }
}
