//! Data like that of roadmaps: clusters, trees, thin surfaces.

use std::f64::consts::TAU;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Forest, ForestOptions, Points, Search, Space};

use super::{factors, uniform};

const CLUSTERS: usize = 50;
/// The standard deviation in a cluster, as a part of the unit interval, of a circle, of the sphere's radius.
const CLUSTER_SPREAD: f64 = 0.02;

const TREES: usize = 5;
/// The length of one extension of a tree, as a fraction of the mean distance of two uniform states.
const TREE_STEP: f64 = 0.1;
/// The number of states along an extension: a planner stores this many states of a checked edge.
const STATES_OF_A_STEP: usize = 4;

const SURFACE_THICKNESS: f64 = 1e-3;

/// States about uniform centres.
pub(super) fn clusters(space: &Space, rows: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    let centres: Vec<Vec<f64>> = (0..CLUSTERS).map(|_| uniform(space, rng)).collect();
    let state = |_| {
        let mut row = centres[rng.random_range(0..CLUSTERS)].clone();
        scatter(space, &mut row, CLUSTER_SPREAD, rng);
        row
    };
    (0..rows).map(state).collect()
}

/// Perturbs a state by a normal distribution.
fn scatter(space: &Space, row: &mut [f64], spread: f64, rng: &mut ChaCha8Rng) {
    let mut rest = row;
    for factor in factors(space) {
        let (own, others) = rest.split_at_mut(factor.coordinates());
        let scale = match factor {
            Factor::RealVector(_) | Factor::SO3 => spread,
            Factor::SO2 { period } => spread * period,
        };
        for x in own.iter_mut() {
            *x += scale * normal(rng);
        }
        if factor == Factor::SO3 {
            normalise(own);
        }
        rest = others;
    }
}

/// A normal number of variance 1, approximated by the sum of twelve uniform ones.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0
}

fn normalise(q: &mut [f64]) {
    let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    for x in q {
        *x /= norm;
    }
}

/// States along the edges of trees that grow towards uniform states.
pub(super) fn trees(space: &Space, rows: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    let canonical = |mut row: Vec<f64>| {
        // Interpolation between valid states gives a valid state; `generate` reports an invalid one.
        let _ = space.canonicalize(&mut row);
        row
    };
    let mut pairs = 0.0;
    for _ in 0..100 {
        let (a, b) = (uniform(space, rng), uniform(space, rng));
        pairs += space.distance(&canonical(a), &canonical(b)) / 100.0;
    }
    let mut all: Vec<Vec<f64>> = Vec::with_capacity(rows);
    for tree in 1..=TREES {
        let last = rows * tree / TREES;
        let mut grown = Forest::new(space.clone(), ForestOptions::for_space(space));
        let mut edge = vec![canonical(uniform(space, rng))];
        loop {
            for row in edge.drain(..) {
                let mut point = Points::with_capacity(space.coordinates(), 1);
                point.push(all.len() as u64, 0, 1, &row);
                grown
                    .apply(grown.revision() + 1, &point, &[])
                    .expect("canonical states");
                grown.settle();
                all.push(row);
            }
            if all.len() >= last {
                break;
            }
            let towards = canonical(uniform(space, rng));
            let answer = grown
                .search(&towards, &Search::nearest_k(1))
                .expect("canonical states");
            let from = &all[answer.neighbors[0].id as usize];
            let whole = (TREE_STEP * pairs / space.distance(from, &towards)).min(1.0);
            for step in 1..=STATES_OF_A_STEP {
                let part = whole * step as f64 / STATES_OF_A_STEP as f64;
                edge.push(canonical(between(space, from, &towards, part)));
            }
        }
        all.truncate(last);
    }
    all
}

fn between(space: &Space, a: &[f64], b: &[f64], part: f64) -> Vec<f64> {
    let (mut row, mut at) = (Vec::with_capacity(a.len()), 0);
    for factor in factors(space) {
        let own = at..at + factor.coordinates();
        let pairs = a[own.clone()].iter().zip(&b[own.clone()]);
        match factor {
            Factor::RealVector(_) => row.extend(pairs.map(|(a, b)| a + part * (b - a))),
            Factor::SO2 { period } => row.extend(pairs.map(|(a, b)| {
                let turn = b - a;
                a + part * (turn - period * (turn / period).round())
            })),
            Factor::SO3 => {
                let dot: f64 = pairs.clone().map(|(a, b)| a * b).sum();
                row.extend(pairs.map(|(a, b)| a * (1.0 - part) + b * part * dot.signum()));
                normalise(&mut row[at..]);
            }
        }
        at = own.end;
    }
    row
}

/// A surface over (u, v) in [0, 1)², each coordinate a wave of its own over it.
pub(super) fn manifold(space: &Space, rows: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<f64>> {
    let waves: Vec<[f64; 3]> = (0..space.coordinates())
        .map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0)))
        .collect();
    let state = |_| {
        let (u, v) = (rng.random::<f64>(), rng.random::<f64>());
        let height = |[a, b, phase]: &[f64; 3]| (TAU * (a * u + b * v + phase)).sin();
        let (mut row, mut at) = (Vec::with_capacity(waves.len()), 0);
        for factor in factors(space) {
            let own = waves[at..at + factor.coordinates()].iter().map(height);
            match factor {
                Factor::RealVector(_) => row.extend(own.map(|x| 0.5 + 0.5 * x)),
                Factor::SO2 { period } => row.extend(own.map(|x| 0.4 * period * x)),
                Factor::SO3 => {
                    row.extend(own);
                    normalise(&mut row[at..]);
                }
            }
            at += factor.coordinates();
        }
        scatter(space, &mut row, SURFACE_THICKNESS, rng);
        row
    };
    (0..rows).map(state).collect()
}
