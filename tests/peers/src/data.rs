//! States to store and query states, the same in every run.
//!
//! Query states have the same distribution as the stored states, but differ from them.

mod uneven;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Space, Term};

use crate::problem::Problem;

/// The distribution of states, and the order of their arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Data {
    /// Coordinates uniform in [0, 1), angles and rotations uniform.
    Uniform,
    /// The uniform states by ascending first coordinate: the worst order for a tree that grows.
    Sorted,
    /// Fifty narrow clusters around uniform centres.
    Clusters,
    /// States along the edges of rapidly-exploring random trees.
    Rrt,
    /// A curved surface of two dimensions, a thousandth thick.
    Manifold,
}

impl Data {
    /// All distributions except the uniform one.
    pub const UNEVEN: [Data; 4] = [Data::Sorted, Data::Clusters, Data::Rrt, Data::Manifold];

    /// The name in the tables.
    pub fn name(self) -> &'static str {
        match self {
            Data::Uniform => "uniform",
            Data::Sorted => "sorted",
            Data::Clusters => "clusters",
            Data::Rrt => "rrt-trees",
            Data::Manifold => "manifold",
        }
    }
}

/// Rows of one width, one after the other.
#[derive(Clone, Debug)]
pub struct Rows {
    width: usize,
    numbers: Vec<f64>,
}

impl Rows {
    /// The number of rows.
    pub fn len(&self) -> usize {
        self.numbers.len() / self.width
    }

    /// All numbers, row after row.
    pub fn numbers(&self) -> &[f64] {
        &self.numbers
    }

    /// One row.
    pub fn row(&self, at: usize) -> &[f64] {
        &self.numbers[at * self.width..][..self.width]
    }

    /// All rows.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &[f64]> {
        self.numbers.chunks_exact(self.width)
    }
}

/// `points` states to store and `queries` query states, all canonical.
///
/// # Errors
/// The space refuses a state: a bug of the generator.
pub fn generate(
    space: &Space,
    data: Data,
    points: usize,
    queries: usize,
) -> Result<(Rows, Rows), Problem> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let all = points + queries;
    let mut rows: Vec<Vec<f64>> = match data {
        Data::Uniform | Data::Sorted => (0..all).map(|_| uniform(space, &mut rng)).collect(),
        Data::Clusters => uneven::clusters(space, all, &mut rng),
        Data::Rrt => uneven::trees(space, all, &mut rng),
        Data::Manifold => uneven::manifold(space, all, &mut rng),
    };
    for row in &mut rows {
        space.canonicalize(row).map_err(|source| Problem::State {
            data: data.name(),
            space: space.to_string(),
            source,
        })?;
    }
    let width = space.coordinates();
    let (mut stored, mut query_rows) = (Vec::new(), Vec::new());
    for (at, row) in rows.into_iter().enumerate() {
        // The queries are spread evenly over the sequence, because a tree's late states lie elsewhere than its first
        // ones.
        let is_query = (at + 1) * queries / all > at * queries / all;
        if is_query {
            &mut query_rows
        } else {
            &mut stored
        }
        .push(row);
    }
    if data == Data::Sorted {
        stored.sort_by(|a, b| a[0].total_cmp(&b[0]));
    }
    let flat = |rows: Vec<Vec<f64>>| Rows {
        width,
        numbers: rows.concat(),
    };
    Ok((flat(stored), flat(query_rows)))
}

/// The factors of a space in row order.
fn factors(space: &Space) -> impl Iterator<Item = Factor> {
    let terms = space.groups().iter().flat_map(|group| &group.terms);
    terms.map(|term: &Term| term.factor)
}

fn uniform(space: &Space, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut row = Vec::with_capacity(space.coordinates());
    for factor in factors(space) {
        match factor {
            Factor::RealVector(n) => row.extend((0..n).map(|_| rng.random::<f64>())),
            Factor::SO2 { period } => row.push((rng.random::<f64>() - 0.5) * period),
            Factor::SO3 => row.extend(rotation(rng)),
        }
    }
    row
}

/// A uniform rotation: a point of a cube that lies in the ball, brought to the sphere.
fn rotation(rng: &mut ChaCha8Rng) -> [f64; 4] {
    loop {
        let q: [f64; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let norm_2: f64 = q.iter().map(|x| x * x).sum();
        if (0.01..=1.0).contains(&norm_2) {
            return q.map(|x| x / norm_2.sqrt());
        }
    }
}
