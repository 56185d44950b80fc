//! Rigid bodies made of boxes, among boxes, with rows of `R3*SO3` as poses: the common parts of the scenes in space.

use parry3d_f64::{
    math::{Pose, Rotation, Vector},
    shape::Cuboid,
};

/// The paper's weight of rotations, which are measured by half their angle.
pub const ROTATION_WEIGHT: f64 = 0.15;

/// An axis-aligned box: its lower and upper corner.
pub type Block = ([f64; 3], [f64; 3]);

/// The pose and the shape of a box.
pub fn block((low, high): Block) -> (Pose, Cuboid) {
    let (low, high) = (Vector::from(low), Vector::from(high));
    let at = Pose::from_translation((low + high) / 2.0);
    (at, Cuboid::new((high - low) / 2.0))
}

/// The parts of a body, each given by its centre and half of its sides: their poses in it and their shapes, thicker by
/// the margin on all sides.
pub fn parts<const N: usize>(of: [([f64; 3], [f64; 3]); N], margin: f64) -> [(Pose, Cuboid); N] {
    of.map(|(center, half)| {
        let shape = Cuboid::new(Vector::from(half) + Vector::splat(margin));
        (Pose::from_translation(Vector::from(center)), shape)
    })
}

/// The farthest that a point of a body with this radius moves between a state of a motion and the nearest checked
/// state. Half a resolution is divided between translation and rotation, and a point at the radius r moves by 2r for
/// each unit of a rotation's distance. The planner checks bodies that are thicker by this margin on all sides.
pub fn margin(radius: f64, resolution: f64) -> f64 {
    let turning = 2.0 * radius / ROTATION_WEIGHT.sqrt();
    resolution / 2.0 * 1.0_f64.hypot(turning)
}

/// The pose of a body in a row.
pub fn pose(row: &[f64]) -> Pose {
    let rotation = Rotation::from_xyzw(row[3], row[4], row[5], row[6]);
    Pose::from_parts(Vector::new(row[0], row[1], row[2]), rotation)
}

/// The corners of a box.
pub fn corners(at: &Pose, shape: &Cuboid) -> [Vector; 8] {
    let half = shape.half_extents;
    std::array::from_fn(|corner| {
        let side = |axis: usize| if corner >> axis & 1 == 0 { -1.0 } else { 1.0 };
        at.transform_point(half * Vector::new(side(0), side(1), side(2)))
    })
}

/// True if all corners of a box are inside a room, which begins at the origin and has these sides.
pub fn is_inside(at: &Pose, shape: &Cuboid, sides: [f64; 3]) -> bool {
    corners(at, shape)
        .iter()
        .all(|corner| (0..3).all(|axis| (0.0..=sides[axis]).contains(&corner[axis])))
}
