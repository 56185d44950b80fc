//! Boxes in space on a flat picture: parallel projection, the nearest drawn last.

use parry3d_f64::math::{Pose, Vector};

/// The position of the viewer.
pub struct View {
    right: Vector,
    up: Vector,
    /// Towards the viewer.
    near: Vector,
}

impl View {
    /// The viewer at this azimuth (0 is the front, looking along y) and this height above the horizon, in radians.
    pub fn new(round: f64, above: f64) -> View {
        let level = Vector::new(round.sin(), -round.cos(), 0.0);
        let near = level * above.cos() + Vector::Z * above.sin();
        let up = Vector::Z * above.cos() - level * above.sin();
        View {
            right: Vector::new(round.cos(), round.sin(), 0.0),
            up,
            near,
        }
    }

    /// The position of a point in the picture.
    pub fn project(&self, point: Vector) -> (f64, f64) {
        (point.dot(self.right), point.dot(self.up))
    }
}

/// One side of a box.
pub struct Face<C> {
    /// Its corners in the picture, in cyclic order.
    pub corners: [(f64, f64); 4],
    /// Its brightness, up to 1.
    pub light: f64,
    /// The value that was given for its box.
    pub color: C,
    depth: f64,
}

/// The visible sides of a box.
pub fn faces<C: Copy>(view: &View, pose: &Pose, half: Vector, color: C, faces: &mut Vec<Face<C>>) {
    let sun = Vector::new(0.35, -0.5, 0.8).normalize();
    let axes = [Vector::X, Vector::Y, Vector::Z];
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let normal = pose.rotation * (axes[axis] * side);
            if normal.dot(view.near) <= 0.0 {
                continue;
            }
            let [across, along] = [axes[(axis + 1) % 3], axes[(axis + 2) % 3]];
            let corner = |(i, j): (f64, f64)| {
                pose.transform_point(half * (axes[axis] * side + across * i + along * j))
            };
            let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(corner);
            let middle = (corners[0] + corners[2]) / 2.0;
            faces.push(Face {
                corners: corners.map(|corner| view.project(corner)),
                light: 0.72 + 0.28 * normal.dot(sun).max(0.0),
                color,
                depth: middle.dot(view.near),
            });
        }
    }
}

/// Sorts far sides before near ones.
pub fn sort<C>(faces: &mut [Face<C>]) {
    faces.sort_by(|a, b| a.depth.total_cmp(&b.depth));
}
