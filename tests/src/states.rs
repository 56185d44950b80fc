//! Seeded states.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Space};

/// Draws states of a space: coordinates of `RealVector` uniform in [0, 10), angles uniform over three turns, rotations
/// uniform.
#[derive(Clone, Debug)]
pub struct States {
    space: Space,
    rng: ChaCha8Rng,
}

impl States {
    /// Starts a sequence; equal seeds draw equal states.
    pub fn new(space: Space, seed: u64) -> Self {
        Self {
            space,
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// The space of the states.
    pub fn space(&self) -> &Space {
        &self.space
    }

    /// The generator of the states, for other random values of a test.
    pub fn rng(&mut self) -> &mut ChaCha8Rng {
        &mut self.rng
    }

    /// One state.
    pub fn row(&mut self) -> Vec<f64> {
        self.rows(1)
    }

    /// This many states, one after the other.
    pub fn rows(&mut self, count: usize) -> Vec<f64> {
        let mut rows = Vec::with_capacity(count * self.space.coordinates());
        for _ in 0..count {
            for group in self.space.groups() {
                for term in &group.terms {
                    draw(&mut self.rng, term.factor, &mut rows);
                }
            }
        }
        rows
    }
}

fn draw(rng: &mut ChaCha8Rng, factor: Factor, row: &mut Vec<f64>) {
    match factor {
        Factor::RealVector(n) => row.extend((0..n).map(|_| rng.random_range(0.0..10.0))),
        Factor::SO2 { period } => row.push(rng.random_range(-1.5 * period..1.5 * period)),
        Factor::SO3 => loop {
            // A point of the unit ball, normalised to the sphere.
            let q: [f64; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
            let norm_2: f64 = q.iter().map(|x| x * x).sum();
            if (0.01..1.0).contains(&norm_2) {
                row.extend(q.map(|x| x / norm_2.sqrt()));
                break;
            }
        },
    }
}
