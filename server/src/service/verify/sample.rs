//! States to search for, drawn from the stored ones.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Space};

/// The side of the box around a stored state in which states are drawn, as a share of the bounds.
const NEAR_SHARE: f64 = 1e-3;

/// A uniform sample of the stored states, and the bounds of all.
pub(super) struct Sampler {
    space: Space,
    random: ChaCha8Rng,
    capacity: usize,
    reservoir: Vec<Box<[f64]>>,
    state_count: u64,
    bounds: Vec<(f64, f64)>,
}

impl Sampler {
    /// Samples at most `capacity` states.
    pub(super) fn new(space: &Space, capacity: usize, seed: u64) -> Self {
        Self {
            random: ChaCha8Rng::seed_from_u64(seed),
            capacity,
            reservoir: Vec::new(),
            state_count: 0,
            bounds: vec![(f64::INFINITY, f64::NEG_INFINITY); space.coordinates()],
            space: space.clone(),
        }
    }

    /// Adds a stored state.
    pub(super) fn add(&mut self, state: &[f64]) {
        for ((low, high), &coordinate) in self.bounds.iter_mut().zip(state) {
            *low = low.min(coordinate);
            *high = high.max(coordinate);
        }
        self.state_count += 1;
        if self.reservoir.len() < self.capacity {
            self.reservoir.push(state.into());
            return;
        }
        let place = self.random.random_range(0..self.state_count);
        let place = usize::try_from(place).ok();
        if let Some(sampled) = place.and_then(|place| self.reservoir.get_mut(place)) {
            *sampled = state.into();
        }
    }

    /// `count` canonical states: half near sampled ones, half anywhere within the bounds.
    pub(super) fn draw(&mut self, count: usize) -> Vec<Vec<f64>> {
        if self.state_count == 0 {
            self.bounds.fill((0.0, 1.0));
        }
        (0..count)
            .filter_map(|at| {
                let sampled = self.reservoir.get(at / 2).filter(|_| at.is_multiple_of(2));
                let sampled = sampled.cloned();
                self.state(sampled.as_deref())
            })
            .collect()
    }

    /// A canonical state, near another or anywhere.
    fn state(&mut self, center: Option<&[f64]>) -> Option<Vec<f64>> {
        let mut state: Vec<f64> = Vec::with_capacity(self.bounds.len());
        for (at, &(low, high)) in self.bounds.iter().enumerate() {
            let share: f64 = self.random.random();
            state.push(match center.and_then(|center| center.get(at)) {
                Some(coordinate) => coordinate + (share - 0.5) * NEAR_SHARE * (high - low),
                None => low + share * (high - low),
            });
        }
        let terms = self.space.groups().iter().flat_map(|group| &group.terms);
        let mut rest = &mut state[..];
        for term in terms {
            let (own, others) = rest.split_at_mut_checked(term.factor.coordinates())?;
            rest = others;
            if term.factor == Factor::SO3 {
                normalise(own);
            } else {
                // An offset from the largest allowed state would exceed it.
                own.iter_mut().for_each(|x| *x = x.clamp(-1e150, 1e150));
            }
        }
        self.space.canonicalize(&mut state).ok()?;
        Some(state)
    }
}

/// Normalises four numbers to a quaternion: the identity if they are too near 0.
fn normalise(quaternion: &mut [f64]) {
    let norm = quaternion.iter().map(|x| x * x).sum::<f64>().sqrt();
    if norm > 1e-6 {
        quaternion.iter_mut().for_each(|x| *x /= norm);
    } else if let Some((w, xyz)) = quaternion.split_last_mut() {
        xyz.fill(0.0);
        *w = 1.0;
    }
}
