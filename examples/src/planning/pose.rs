//! Poses of rigid bodies between two rows of `R3*SO3`, by nalgebra, for checks that share no code with the planners.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use parry3d_f64::math::{Pose, Rotation, Vector};

/// The pose at the fraction `t` of the motion between two rows.
pub fn between(a: &[f64], b: &[f64], t: f64) -> Pose {
    let place = |row: &[f64]| Vector3::new(row[0], row[1], row[2]);
    let turn = |row: &[f64]| {
        UnitQuaternion::new_normalize(Quaternion::new(row[6], row[3], row[4], row[5]))
    };
    let at = place(a).lerp(&place(b), t);
    // nalgebra returns None only between almost equal rotations.
    let turned = turn(a).try_slerp(&turn(b), t, 1e-9).unwrap_or(turn(a));
    let rotation = Rotation::from_xyzw(turned.i, turned.j, turned.k, turned.w);
    Pose::from_parts(Vector::new(at.x, at.y, at.z), rotation)
}
