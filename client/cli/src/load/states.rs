//! Seeded states, drawn evenly over the space of the index.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{Factor, Space};

/// The interval of the coordinates of real vectors, which have no bounds of their own.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Range {
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Default for Range {
    fn default() -> Range {
        Range {
            low: 0.0,
            high: 1.0,
        }
    }
}

impl Range {
    /// The interval of `LOW,HIGH`.
    pub(super) fn parse(text: &str) -> Result<Range, String> {
        let expected = || "expected two numbers, the smaller first, as in 0,1 or -5,5".to_owned();
        let (low, high) = text.split_once(',').ok_or_else(expected)?;
        let number = |text: &str| text.trim().parse::<f64>().ok();
        match (number(low), number(high)) {
            (Some(low), Some(high)) if low < high && (high - low).is_finite() => {
                Ok(Range { low, high })
            }
            _ => Err(expected()),
        }
    }
}

/// Draws states. A state depends only on the seed and on a number, not on the worker that draws it.
#[derive(Clone, Debug)]
pub(super) struct Sampler {
    factors: Vec<Factor>,
    width: usize,
    range: Range,
    rng: ChaCha8Rng,
}

impl Sampler {
    pub(super) fn new(space: &Space, range: Range, seed: u64) -> Sampler {
        let terms = space.groups().iter().flat_map(|group| &group.terms);
        Sampler {
            factors: terms.map(|term| term.factor).collect(),
            width: space.coordinates(),
            range,
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// A sequence of random numbers of its own.
    pub(super) fn stream(&self, number: u64) -> ChaCha8Rng {
        let mut rng = self.rng.clone();
        rng.set_stream(number);
        rng
    }

    /// This many states, one after the other.
    pub(super) fn rows(&self, rng: &mut ChaCha8Rng, count: usize) -> Vec<f64> {
        let mut rows = Vec::with_capacity(count * self.width);
        for _ in 0..count {
            for factor in &self.factors {
                self.draw(rng, *factor, &mut rows);
            }
        }
        rows
    }

    fn draw(&self, rng: &mut ChaCha8Rng, factor: Factor, row: &mut Vec<f64>) {
        let Range { low, high } = self.range;
        match factor {
            Factor::RealVector(n) => row.extend((0..n).map(|_| rng.random_range(low..high))),
            Factor::SO2 { period } => row.push(rng.random_range(-period / 2.0..period / 2.0)),
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
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sampler(space: &str, range: Range, seed: u64) -> Sampler {
        Sampler::new(&space.parse().unwrap(), range, seed)
    }

    #[test]
    fn a_number_names_the_same_states_whoever_draws_them() {
        let one = sampler("R3*SO3", Range::default(), 7);
        let rows = |sampler: &Sampler, number| sampler.rows(&mut sampler.stream(number), 3);
        assert_eq!(rows(&one, 5), rows(&one.clone(), 5));
        assert_ne!(rows(&one, 5), rows(&one, 6));
        let other = sampler("R3*SO3", Range::default(), 8);
        assert_ne!(rows(&one, 5), rows(&other, 5));
    }

    #[test]
    fn states_fill_the_space_and_are_of_it() {
        let space: Space = "R2*SO2*SO2[1]*SO3".parse().unwrap();
        let range = Range {
            low: -2.0,
            high: 6.0,
        };
        let sampler = Sampler::new(&space, range, 1);
        let mut rows = sampler.rows(&mut sampler.stream(0), 4_000);
        let mut sums = [0.0; 8];
        for row in rows.chunks_exact_mut(space.coordinates()) {
            assert!(row[..2].iter().all(|x| (-2.0..6.0).contains(x)), "{row:?}");
            assert!((-0.5..0.5).contains(&row[3]), "{row:?}");
            sums.iter_mut().zip(&*row).for_each(|(sum, x)| *sum += x);
            space.canonicalize(row).unwrap();
        }
        // The means of even distributions; a deviation of 0.2 is more than five times what chance gives.
        let expected = [2.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        for (sum, expected) in sums.iter().zip(expected) {
            let mean = sum / 4_000.0;
            assert!((mean - expected).abs() < 0.2, "{sums:?}");
        }
    }

    #[test]
    fn a_range_is_two_numbers() {
        let range = |low, high| Ok(Range { low, high });
        assert_eq!(Range::parse("-5,5"), range(-5.0, 5.0));
        assert_eq!(Range::parse("0, 0.5"), range(0.0, 0.5));
        for wrong in [
            "",
            "1",
            "1,1",
            "2,1",
            "a,1",
            "0,inf",
            "nan,1",
            "0,1,2",
            "-1e308,1e308",
        ] {
            assert!(Range::parse(wrong).is_err(), "{wrong}");
        }
    }
}
