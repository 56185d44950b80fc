//! Distances against independent values: derived by hand, or literals from mpmath at 40 digits.

#![expect(clippy::unwrap_used, reason = "a test stops where its helper fails")]

use std::f64::consts::{FRAC_PI_2, FRAC_PI_3, FRAC_PI_4, FRAC_PI_6, PI};
use wayfold_index::Space;

/// The distance of two rows of a space, brought into canonical form first.
fn distance(space: &str, a: &[f64], b: &[f64]) -> f64 {
    let space: Space = space.parse().unwrap();
    let (mut a, mut b) = (a.to_vec(), b.to_vec());
    space.canonicalize(&mut a).unwrap();
    space.canonicalize(&mut b).unwrap();
    space.distance(&a, &b)
}

/// The rotation by `angle` about the unit `axis`: axis·sin(angle/2), cos(angle/2).
fn rotation(axis: [f64; 3], angle: f64) -> [f64; 4] {
    let (sin, cos) = (libm::sin(angle / 2.0), libm::cos(angle / 2.0));
    [axis[0] * sin, axis[1] * sin, axis[2] * sin, cos]
}

#[track_caller]
fn assert_near(found: f64, expected: f64, relative: f64) {
    assert!(
        (found - expected).abs() <= relative * expected.abs(),
        "{found:e}, not {expected:e}"
    );
}

const X: [f64; 3] = [1.0, 0.0, 0.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];
const Z: [f64; 3] = [0.0, 0.0, 1.0];
const IDENTITY: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

#[test]
fn real_vectors_are_euclidean() {
    assert_eq!(distance("R1", &[-2.0], &[1.5]), 3.5);
    assert_eq!(distance("R2", &[1.0, 1.0], &[4.0, 5.0]), 5.0); // 3-4-5
    assert_eq!(distance("R3", &[0.0; 3], &[2.0, 3.0, 6.0]), 7.0); // 4 + 9 + 36 = 49
    assert_eq!(distance("R4", &[0.5; 4], &[-0.5; 4]), 2.0); // the cube's diagonal in R4
    assert_eq!(
        distance("R3", &[1e150; 3], &[-1e150; 3]),
        12.0_f64.sqrt() * 1e150
    );
    assert_eq!(distance("R1", &[1e-150], &[4e-150]), 3e-150);
}

#[test]
fn circles_take_the_shorter_arc() {
    assert_eq!(distance("SO2", &[0.25], &[1.0]), 0.75);
    assert_near(
        distance("SO2", &[3.0], &[-3.0]),
        0.283_185_307_179_586_5,
        1e-15,
    ); // 2π − 6
    assert_eq!(distance("SO2", &[-PI], &[0.0]), PI);
    assert_eq!(distance("SO2", &[PI], &[-PI]), 0.0);
    assert_eq!(distance("SO2[1]", &[0.0], &[0.75]), 0.25);
    assert_eq!(distance("SO2[1]", &[0.125], &[10.375]), 0.25);
    assert_eq!(distance("SO2[24]", &[23.0], &[1.5]), 2.5); // the hours of a clock
    assert_eq!(distance("SO2[360]", &[350.0], &[-350.0]), 20.0); // degrees
}

#[test]
fn rotations_are_half_their_angle_apart() {
    for (angle, half) in [
        (PI / 3.0, FRAC_PI_6),
        (FRAC_PI_2, FRAC_PI_4),
        (2.0 * FRAC_PI_3, FRAC_PI_3),
        (PI, FRAC_PI_2),
        (-FRAC_PI_2, FRAC_PI_4),
        (1.5 * PI, FRAC_PI_4), // three quarters round is a quarter back
    ] {
        for axis in [X, Y, Z, [0.6, 0.0, -0.8]] {
            assert_near(
                distance("SO3", &IDENTITY, &rotation(axis, angle)),
                half,
                1e-15,
            );
        }
    }
    // A third of a turn about the diagonal of the cube moves x to y to z: the quaternion (1, 1, 1, 1)/2.
    assert_near(distance("SO3", &IDENTITY, &[0.5; 4]), FRAC_PI_3, 1e-15);
    // Half turns about x and about y differ by a half turn about z, the farthest there is: exactly π/2.
    assert_eq!(
        distance("SO3", &[1.0, 0.0, 0.0, 0.0], &[0.0, 1.0, 0.0, 0.0]),
        FRAC_PI_2
    );
    // 30° about z against 40° about x: cos θ = cos 15° · cos 20°.
    let (yaw, roll) = (rotation(Z, FRAC_PI_6), rotation(X, 2.0 * PI / 9.0));
    assert_near(distance("SO3", &yaw, &roll), 0.433_089_786_289_170_9, 4e-15);
}

#[test]
fn rotations_are_the_arc_cosine_of_the_dot_product() {
    // (1, 2, 3, 4)·(4, −3, 2, 1) = 8, both of length √30.
    let root = 30_f64.sqrt();
    let (a, b) = ([1.0, 2.0, 3.0, 4.0], [4.0, -3.0, 2.0, 1.0]);
    let (a, b) = (a.map(|x| x / root), b.map(|x| x / root));
    assert_near(distance("SO3", &a, &b), 1.300_863_530_961_493, 4e-16);
    // (2, −1, 0, −2)/3 and (1, 0, 0, 0): cos θ = 2/3; with −2/3 the same rotation is meant.
    let c = [2.0, -1.0, 0.0, -2.0].map(|x| x / 3.0);
    for b in [[1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]] {
        assert_near(distance("SO3", &c, &b), 0.841_068_670_567_930_3, 4e-16);
    }
}

/// Near a cosine of 1, the arc cosine is 0 or has no correct digit; see W. Kahan, "How Futile are Mindless Assessments
/// of Roundoff", on the angle between vectors. The sine of a small t is t − t³/6.
#[test]
fn small_rotations_keep_all_their_digits() {
    for t in [1e-4, 1e-7, 1e-9, 1e-12, 1e-15, 1e-100] {
        let turned = [0.0, t - t * t * t / 6.0, 0.0, 1.0 - t * t / 2.0];
        assert_near(distance("SO3", &IDENTITY, &turned), t, 1e-15);
        assert_near(distance("SO3", &turned, &turned.map(|x| -x)), 0.0, 0.0);
    }
    // Two turns about x by 1 rad and by 1 rad + 2e-9; their coordinates are only known to 1e-16.
    let (a, b) = (rotation(X, 1.0), rotation(X, 1.0 + 2e-9));
    assert_near(distance("SO3", &a, &b), 1e-9, 2e-7);
    // Near a half turn the nearer of q and −q changes with the sign of w.
    let (a, b) = ([1.0, 0.0, 0.0, 1e-9], [1.0, 0.0, 0.0, -1e-9]);
    assert_near(distance("SO3", &a, &b), 2e-9, 1e-15);
}

#[test]
fn nearly_equal_rotations_are_not_equal() {
    let nearly = [0.0, 0.0, f64::EPSILON, 1.0];
    assert_eq!(distance("SO3", &IDENTITY, &nearly), f64::EPSILON);
}

#[test]
fn a_weight_within_a_product_multiplies_the_square() {
    // A translation by 3-4-5 and a quarter turn: √(25 + 0.15·(π/4)²), the paper's weights for SE(3).
    let (a, b) = ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], rotation(Z, FRAC_PI_2));
    let b = [3.0, 4.0, 0.0, b[0], b[1], b[2], b[3]];
    for space in ["R3*SO3:0.15", "mpnn-se3"] {
        assert_near(distance(space, &a, &b), 5.009_244_208_586_782, 2e-16);
    }
    assert_eq!(
        Space::se3().distance(&a, &b),
        distance("R3*SO3:0.15", &a, &b)
    );
    // R2*SO2: √(25 + (π/2)²).
    let (a, b) = ([0.0, 0.0, PI / 4.0], [3.0, 4.0, -PI / 4.0]);
    assert_near(Space::se2().distance(&a, &b), 5.240_935_136_048_942, 2e-16);
    assert_eq!(distance("R1:4*R1:9", &[0.0, 0.0], &[2.0, 1.0]), 5.0); // √(4·4 + 9·1)
    assert_eq!(distance("R1:0*R1", &[0.0, 0.0], &[2.0, 1.0]), 1.0);
}

#[test]
fn a_weight_within_a_sum_multiplies_the_distance() {
    assert_eq!(distance("sum(R1:4, R1:9)", &[0.0, 0.0], &[2.0, 1.0]), 17.0); // 4·2 + 9·1
    assert_eq!(
        distance("sum(R2:2, (R1:4):0.5)", &[0.0; 3], &[3.0, 4.0, 3.0]),
        13.0
    ); // 2·5 + ½·√(4·9)
    assert_eq!(distance("sum(R1:0, R1)", &[0.0, 0.0], &[2.0, 1.0]), 1.0);
}

/// OMPL's `CompoundStateSpace::distance` adds `weight * distance` of its subspaces: `SE2StateSpace` takes R2 with
/// weight 1 and SO2 with 0.5, `SE3StateSpace` R3 and SO3 with 1; SO3's distance is acos |q₁·q₂|. Its
/// `TorusStateSpace` takes the root of the two squared arcs.
#[test]
fn ompl_presets_measure_as_ompl() {
    let (a, b) = ([1.0, 1.0, 3.0 * FRAC_PI_4], [4.0, 5.0, -3.0 * FRAC_PI_4]);
    assert_near(distance("ompl-se2", &a, &b), 5.0 + FRAC_PI_4, 2e-16);
    let (a, b) = (
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        [2.0, 3.0, 6.0, 0.5, 0.5, 0.5, 0.5],
    );
    assert_near(distance("ompl-se3", &a, &b), 7.0 + FRAC_PI_3, 2e-16);
    // Arcs of 1 and of 2π − 6.
    assert_near(
        distance("ompl-torus", &[0.0, 3.0], &[1.0, -3.0]),
        1.039_323_779_292_284_2,
        1e-15,
    );
}

/// MoveIt's `JointModelGroup::distance` adds the distances of the joints.
#[test]
fn moveit_joints_add_up() {
    let b = [0.5, -0.25, 0.0, 1.0, -1.0, 0.125, 0.125];
    assert_eq!(distance("moveit-joints-7", &[0.0; 7], &b), 3.0);
}

#[test]
fn one_group_of_joints_beside_another() {
    // A torus of arcs 3 and 4 on circles of circumference 100, and a translation of 7.
    let (a, b) = ([0.0; 5], [3.0, -4.0, 2.0, 3.0, 6.0]);
    assert_eq!(distance("sum((SO2[100]^2), R3)", &a, &b), 12.0);
    assert_eq!(distance("sum(SO2[100]^2, R3)", &a, &b), 14.0);
}

#[test]
fn eight_bodies_are_one_group() {
    let (a, mut b) = ([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0].repeat(8), Vec::new());
    for body in 0..8 {
        let q = rotation(Y, FRAC_PI_2);
        b.extend([f64::from(body), 0.0, 0.0, q[0], q[1], q[2], q[3]]);
    }
    // Σ body² = 140; eight quarter turns, each half its angle apart.
    let expected = (140.0 + 8.0 * 0.15 * FRAC_PI_4 * FRAC_PI_4).sqrt();
    assert_near(distance("(R3*RP3:0.15)^8", &a, &b), expected, 4e-16);
}
