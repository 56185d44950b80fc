//! The states of a random history: not in canonical form, as a user may write them.

use rand::RngExt;
use wayfold::Space;

use super::Model;

impl Model {
    /// A state as a user may write it: not in canonical form.
    pub(super) fn state(&mut self) -> Vec<f64> {
        let mut row = Vec::new();
        for coordinate in wayfold::coordinate_names(self.index.space()) {
            // Few values, so that distances are often equal.
            let number = f64::from(self.rng.random_range(0..8)) / 4.0 - 1.0;
            row.push(match coordinate.as_str() {
                name if name.starts_with("theta") => number * 7.0,
                _ => number,
            });
        }
        normalize_rotations(self.index.space(), &mut row);
        row
    }

    pub(super) fn canonical(&self, state: &[f64]) -> Vec<f64> {
        let mut row = state.to_vec();
        self.index.space().canonicalize(&mut row).unwrap();
        row
    }
}

/// Scales the rotations of a row to unit length; a quaternion of zeros becomes the identity.
fn normalize_rotations(space: &Space, row: &mut [f64]) {
    let mut at = 0;
    let terms = space.groups().iter().flat_map(|group| &group.terms);
    for factor in terms.map(|term| term.factor) {
        let width = match factor {
            wayfold::Factor::RealVector(n) => n,
            wayfold::Factor::SO2 { .. } => 1,
            wayfold::Factor::SO3 => {
                let rotation = &mut row[at..at + 4];
                let norm = rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
                match norm {
                    0.0 => rotation.copy_from_slice(&[0.0, 0.0, 0.0, 1.0]),
                    norm => rotation.iter_mut().for_each(|x| *x /= norm),
                }
                4
            }
        };
        at += width;
    }
}
