//! Interpolated states, against known values and against the metric.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

use std::f64::consts::{FRAC_PI_2, FRAC_PI_3, FRAC_PI_4, FRAC_PI_6, PI};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Space};

fn canonical(space: &Space, row: &[f64]) -> Vec<f64> {
    let mut row = row.to_vec();
    space.canonicalize(&mut row).unwrap();
    row
}

fn between(space: &str, a: &[f64], b: &[f64], t: f64) -> Vec<f64> {
    let space: Space = space.parse().unwrap();
    let mut found = vec![f64::NAN; space.coordinates()];
    space.interpolate(&canonical(&space, a), &canonical(&space, b), t, &mut found);
    assert_eq!(found, canonical(&space, &found), "not canonical");
    found
}

#[track_caller]
fn assert_near(found: &[f64], expected: &[f64]) {
    let near = |(x, y): (&f64, &f64)| (x - y).abs() < 1e-15;
    let all = found.len() == expected.len() && found.iter().zip(expected).all(near);
    assert!(all, "{found:?}, not {expected:?}");
}

/// The rotation by `angle` about z.
fn about_z(angle: f64) -> [f64; 4] {
    [0.0, 0.0, libm::sin(angle / 2.0), libm::cos(angle / 2.0)]
}

#[test]
fn segments_are_straight() {
    assert_eq!(between("R2", &[1.0, 2.0], &[3.0, -2.0], 0.25), [1.5, 1.0]);
}

#[test]
fn arcs_take_the_short_way_across_the_seam() {
    let (a, b) = ([PI - 0.1], [-PI + 0.3]); // 0.4 apart
    assert_near(&between("SO2", &[0.5], &[1.5], 0.5), &[1.0]);
    assert_near(&between("SO2", &a, &b, 0.125), &[PI - 0.05]);
    assert_near(&between("SO2", &a, &b, 0.5), &[-PI + 0.1]);
    assert_near(&between("SO2", &b, &a, 0.5), &[-PI + 0.1]);
    assert_eq!(between("SO2[24]", &[23.0], &[3.0], 0.5), [1.0]);
    assert_eq!(between("SO2[24]", &[-6.0], &[6.0], 0.5), [0.0]);
}

#[test]
fn rotations_turn_about_a_fixed_axis() {
    let (a, b) = (about_z(FRAC_PI_6), about_z(FRAC_PI_2));
    assert_near(&between("SO3", &a, &b, 0.5), &about_z(FRAC_PI_3));
    assert_near(&between("SO3", &a, &b, 0.25), &about_z(FRAC_PI_4));
    // A sixth forwards and a third backwards: the short way is through 0, for any signs.
    let back = about_z(-FRAC_PI_3);
    for b in [back, back.map(|x| -x)] {
        assert_near(&between("SO3", &a, &b, 1.0 / 3.0), &about_z(0.0));
    }
    // Near the half turn the short way goes on forwards: from 150° to −150° through 180°.
    let found = between(
        "SO3",
        &about_z(5.0 * FRAC_PI_6),
        &about_z(-5.0 * FRAC_PI_6),
        0.5,
    );
    assert_near(&found, &[0.0, 0.0, 1.0, found[3]]);
    assert!(found[3].abs() < 1e-15);
}

#[test]
fn near_rotations_do_not_lose_their_way() {
    for angle in [0.0, 1e-300, 1e-12, 1e-8, 1e-7, 1e-4] {
        let found = between("SO3", &about_z(0.0), &about_z(angle), 0.5);
        let expected = libm::sin(angle / 4.0);
        assert!((found[2] - expected).abs() <= 1e-15 * expected, "{angle}");
    }
}

fn draw(space: &Space, rng: &mut impl Rng) -> Vec<f64> {
    let mut row = Vec::new();
    for term in space.groups().iter().flat_map(|group| &group.terms) {
        match term.factor {
            Factor::RealVector(n) => row.extend((0..n).map(|_| rng.random_range(-5.0..5.0))),
            Factor::SO2 { period } => row.push(rng.random_range(-period..period)),
            Factor::SO3 => {
                let mut q = [0.0_f64; 4];
                let norm = loop {
                    q = q.map(|_| rng.random_range(-1.0..1.0));
                    let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
                    if (0.1..1.0).contains(&norm) {
                        break norm;
                    }
                };
                row.extend(q.map(|x| x / norm));
            }
        }
    }
    canonical(space, &row)
}

#[test]
fn distances_divide_as_the_way_does() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    for text in [
        "R3",
        "SO2[5]",
        "SO3",
        "R2*SO2:0.3",
        "(R3*SO3:0.15)^8",
        "sum(R3, SO3:0.5, SO2^2)",
    ] {
        let space: Space = text.parse().unwrap();
        for _ in 0..500 {
            let (a, b) = (draw(&space, &mut rng), draw(&space, &mut rng));
            let t = rng.random_range(0.0..1.0);
            let mut x = vec![0.0; space.coordinates()];
            space.interpolate(&a, &b, t, &mut x);
            assert_eq!(x, canonical(&space, &x), "{text}");
            let whole = space.distance(&a, &b);
            let (before, after) = (space.distance(&a, &x), space.distance(&x, &b));
            assert!((before - t * whole).abs() < 1e-13 * whole, "{text}: {t}");
            assert!((after - (1.0 - t) * whole).abs() < 1e-13 * whole, "{text}");
        }
    }
}

#[test]
fn ends_are_kept_to_the_bit() {
    let space = Space::se3();
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    let (a, b) = (draw(&space, &mut rng), draw(&space, &mut rng));
    let mut x = [0.0; 7];
    for (t, end) in [(0.0, &a), (-1.0, &a), (f64::NAN, &a), (1.0, &b), (2.0, &b)] {
        space.interpolate(&a, &b, t, &mut x);
        assert_eq!(x, end[..]);
    }
}
