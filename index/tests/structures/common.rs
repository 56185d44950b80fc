//! The shared parts of the suites: the spaces, the data, and an independent brute force.

use std::{
    collections::HashSet,
    f64::consts::{PI, TAU},
};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Filter, Neighbor, PointRef, Points, Search, Space};

/// The spaces in which every structure is tested.
pub const SPACES: [&str; 17] = [
    "R1",
    "R3",
    "R6",
    "SO2",
    "SO2^3",
    "SO2^6",
    "SO3",
    "R2*SO2",
    "R3*SO3:0.15",
    "R3*SO3:15",
    "sum(R3, SO3)",
    "sum((SO2^2), R3)",
    "sum(R1^17)",
    "(R3*RP3:0.15)^2",
    "(R3*RP3:0.15)^8",
    "R2*SO2:0",
    "R1*SO2[1]:15",
];

/// The distribution of the rows of a data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// Coordinates uniform in [0, 1), angles and rotations uniform.
    Uniform,
    /// A few states, each many times.
    Duplicates,
    /// Small whole numbers: ties of distance everywhere.
    Grid,
    /// All on one line through the space.
    Collinear,
    /// Tight clusters far apart.
    Clustered,
    /// Coordinates around 1e149, angles of many turns.
    Large,
    /// Differences whose squares underflow.
    Tiny,
    /// Angles at ±half a period, quaternions with w near 0 and their antipodes.
    Seam,
    /// Distances to a corner that halve with each state, which give the deepest sliding midpoints.
    Geometric,
}

pub const SHAPES: [Shape; 9] = [
    Shape::Uniform,
    Shape::Duplicates,
    Shape::Grid,
    Shape::Collinear,
    Shape::Clustered,
    Shape::Large,
    Shape::Tiny,
    Shape::Seam,
    Shape::Geometric,
];

pub fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// `rows` canonical states.
pub fn states(space: &Space, shape: Shape, rows: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    let distinct: Vec<Vec<f64>> = (0..rows).map(|at| row(space, shape, at, rng)).collect();
    if shape == Shape::Duplicates {
        return (0..rows)
            .map(|_| distinct[rng.random_range(0..rows.min(5))].clone())
            .collect();
    }
    distinct
}

/// Brings one generated state into canonical form.
pub fn row(space: &Space, shape: Shape, at: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut row = Vec::with_capacity(space.coordinates());
    for factor in space.groups().iter().flat_map(|group| &group.terms) {
        match factor.factor {
            Factor::RealVector(n) => row.extend((0..n).map(|_| real(shape, at, rng))),
            Factor::SO2 { period } => row.push(angle(shape, at, period, rng)),
            Factor::SO3 => row.extend(quaternion(shape, at, rng)),
        }
    }
    space.canonicalize(&mut row).expect("a valid state");
    row
}

fn real(shape: Shape, at: usize, rng: &mut ChaCha8Rng) -> f64 {
    let unit: f64 = rng.random();
    match shape {
        Shape::Uniform | Shape::Duplicates | Shape::Seam => unit,
        Shape::Grid => f64::from(rng.random_range(-2..=2)),
        Shape::Collinear => at as f64 / 64.0,
        Shape::Clustered => f64::from(rng.random_range(0..3)) * 100.0 + 1e-6 * unit,
        Shape::Large => (unit - 0.5) * 1e149,
        Shape::Tiny => (unit - 0.5) * 10f64.powi(-rng.random_range(150..310)),
        Shape::Geometric => 0.5f64.powi(at as i32),
    }
}

fn angle(shape: Shape, at: usize, period: f64, rng: &mut ChaCha8Rng) -> f64 {
    let half = period / 2.0;
    match shape {
        Shape::Seam => match rng.random_range(0..4) {
            0 => -half,
            1 => half,
            2 => half - 1e-15 * period * rng.random::<f64>(),
            _ => -half + 1e-3 * period * rng.random::<f64>(),
        },
        Shape::Grid => period * f64::from(rng.random_range(-4..=4)) / 8.0,
        Shape::Large => (rng.random::<f64>() - 0.5) * 1e9 * period,
        Shape::Collinear => period * (at % 64) as f64 / 64.0,
        Shape::Tiny | Shape::Clustered | Shape::Geometric => real(shape, at, rng),
        Shape::Uniform | Shape::Duplicates => (rng.random::<f64>() - 0.5) * period,
    }
}

fn quaternion(shape: Shape, at: usize, rng: &mut ChaCha8Rng) -> [f64; 4] {
    let about_z = |angle: f64| [0.0, 0.0, (angle / 2.0).sin(), (angle / 2.0).cos()];
    let q = match shape {
        Shape::Uniform | Shape::Duplicates | Shape::Large => uniform_rotation(rng),
        Shape::Seam => {
            let [x, y, z, w] = uniform_rotation(rng);
            let w = [0.0, -0.0, 1e-16 * w, 1e-9 * w][rng.random_range(0..4)];
            let norm = (x * x + y * y + z * z + w * w).sqrt();
            [x / norm, y / norm, z / norm, w / norm]
        }
        Shape::Grid => {
            let mut q = [0.0; 4];
            q[rng.random_range(0..4)] = 1.0;
            q
        }
        Shape::Collinear => about_z(TAU * (at % 64) as f64 / 64.0),
        Shape::Clustered => about_z(f64::from(rng.random_range(0..3)) + 1e-6 * rng.random::<f64>()),
        Shape::Tiny => about_z(1e-9 * rng.random::<f64>()),
        Shape::Geometric => about_z(PI * 0.5f64.powi(at as i32)),
    };
    // Either sign is the same rotation.
    if rng.random() { q } else { q.map(|x| -x) }
}

/// Uniform on the sphere, by rejection from the cube.
fn uniform_rotation(rng: &mut impl Rng) -> [f64; 4] {
    loop {
        let q: [f64; 4] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
        let norm_2: f64 = q.iter().map(|x| x * x).sum();
        if (0.01..=1.0).contains(&norm_2) {
            return q.map(|x| x / norm_2.sqrt());
        }
    }
}

/// A table of points with ids that are not their slots, a few tags, and revisions that grow.
pub fn table(space: &Space, states: &[Vec<f64>]) -> Points {
    let mut points = Points::new(space.coordinates());
    for (at, state) in states.iter().enumerate() {
        let at = at as u64;
        points.push((at * 7919) % 1_000_003, at % 3, 1 + at / 10, state);
    }
    points
}

/// Brute force in its plainest form: measure all, sort, truncate.
pub fn brute_force<'a>(
    space: &Space,
    points: impl IntoIterator<Item = PointRef<'a>>,
    state: &[f64],
    search: &Search<'_>,
) -> Vec<Neighbor> {
    let Filter {
        tag_mask,
        tag_value,
        since_revision,
    } = search.filter;
    let mut all: Vec<Neighbor> = points
        .into_iter()
        .filter(|point| point.tag & tag_mask == tag_value && point.revision > since_revision)
        .filter(|point| !search.excluded.iter().any(|ids| ids.contains(&point.id)))
        .map(|point| Neighbor {
            distance: space.distance(state, point.row),
            id: point.id,
        })
        .filter(|neighbor| neighbor.distance <= search.radius)
        .collect();
    all.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.id.cmp(&b.id)));
    all.truncate(search.k);
    all
}

/// Equality in ids and in the bits of the distances.
#[track_caller]
pub fn assert_same(found: &[Neighbor], expected: &[Neighbor], what: &str) {
    let bits = |neighbors: &[Neighbor]| -> Vec<(u64, u64)> {
        neighbors
            .iter()
            .map(|n| (n.distance.to_bits(), n.id))
            .collect()
    };
    assert_eq!(
        bits(found),
        bits(expected),
        "{what}\nfound {found:?}\nexpected {expected:?}"
    );
}

/// The searches made in every structure around one state, whose true neighbours are `near`, nearest first.
pub fn searches<'a>(
    near: &[Neighbor],
    points: usize,
    excluded: &'a [&'a HashSet<u64>],
) -> Vec<(String, Search<'a>)> {
    let mut searches = Vec::new();
    let mut ask = |name: &str, search: Search<'a>| searches.push((name.to_owned(), search));
    for k in [0, 1, 2, 10, points, points + 5] {
        ask(&format!("k={k}"), Search::nearest_k(k));
    }
    ask("r=0", Search::nearest_r(0.0));
    ask("r=inf", Search::nearest_r(f64::INFINITY));
    if let Some(at) = near.get(near.len() / 3) {
        // The radius is exactly the distance of a point, because the ball is closed.
        let mut search = Search::nearest_r(at.distance);
        ask("r", search);
        search.k = 4;
        ask("k and r", search);
    }
    let mut search = Search::nearest_k(5);
    search.filter = Filter {
        tag_mask: 3,
        tag_value: 1,
        since_revision: 0,
    };
    ask("k, tag", search);
    search.filter.since_revision = 1 + points as u64 / 20;
    ask("k, tag, since", search);
    let mut search = Search::nearest_k(5);
    search.excluded = excluded;
    ask("k, excluded", search);
    searches
}
