//! Boxes in three dimensions on a flat picture, in the order in which they hide each other.

use parry3d_f64::{
    math::{Pose, Vector},
    shape::Cuboid,
};
use plotters::{
    prelude::{PathElement, Polygon, RGBColor},
    style::Color,
};

use crate::planning::{
    body::corners,
    drawing::{Area, DrawingError},
};

/// An oblique projection: x to the right, z upwards, y into the depth.
#[derive(Clone, Copy)]
pub struct Projection {
    /// The position of the origin, in pixels.
    pub origin: (f64, f64),
    /// Pixels for each unit of x and z.
    pub scale: f64,
}

/// The shift of a point one unit deeper: to the right, and up.
pub const DEPTH: [f64; 2] = [0.46, 0.40];

/// Towards the eye.
const VIEW_DIRECTION: Vector = Vector::new(DEPTH[0], -1.0, DEPTH[1]);

/// Towards the light.
const LIGHT_DIRECTION: Vector = Vector::new(0.35, -0.55, 0.76);

impl Projection {
    /// The position of a point in the picture.
    pub fn at(&self, point: Vector) -> (i32, i32) {
        let right = point.x + DEPTH[0] * point.y;
        let up = point.z + DEPTH[1] * point.y;
        let pixel = |from: f64, by: f64| (from + self.scale * by).round() as i32;
        (pixel(self.origin.0, right), pixel(self.origin.1, -up))
    }
}

/// Boxes that are drawn together, in one colour.
pub struct Solid {
    /// The pose and the shape of each box.
    pub boxes: Vec<(Pose, Cuboid)>,
    /// The colour in full light.
    pub color: RGBColor,
    /// Its opacity: at 1 it hides everything behind it.
    pub opacity: f64,
    /// The colour of its edges.
    pub outline: RGBColor,
}

impl Solid {
    /// The lower and upper corner of its bounding box.
    fn extent(&self) -> (Vector, Vector) {
        let all = self.boxes.iter().flat_map(|(at, shape)| corners(at, shape));
        let none = (Vector::splat(f64::INFINITY), Vector::splat(-f64::INFINITY));
        all.fold(none, |(low, high), corner| {
            (low.min(corner), high.max(corner))
        })
    }

    /// Draws the faces that point towards the eye, lit by their angle to the light.
    fn draw(&self, area: &Area<'_>, projection: &Projection) -> Result<(), DrawingError> {
        let mut boxes: Vec<&(Pose, Cuboid)> = self.boxes.iter().collect();
        boxes.sort_by(|(a, _), (b, _)| nearness(a).total_cmp(&nearness(b)));
        for (at, shape) in boxes {
            let half = shape.half_extents;
            for axis in 0..3 {
                for side in [-1.0, 1.0] {
                    let mut normal = Vector::ZERO;
                    normal[axis] = side;
                    let outwards = at.rotation * normal;
                    if outwards.dot(VIEW_DIRECTION) <= 0.0 {
                        continue;
                    }
                    let (next, last) = ((axis + 1) % 3, (axis + 2) % 3);
                    let around = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
                    let face = around.map(|(one, two)| {
                        let mut corner = Vector::ZERO;
                        corner[axis] = side * half[axis];
                        corner[next] = one * half[next];
                        corner[last] = two * half[last];
                        projection.at(at.transform_point(corner))
                    });
                    let fill = shaded(self.color, outwards.dot(LIGHT_DIRECTION)).mix(self.opacity);
                    area.draw(&Polygon::new(face.to_vec(), fill))?;
                    let closed: Vec<_> = face.iter().chain(face.first()).copied().collect();
                    let edge = self.outline.mix(self.opacity.max(0.5)).stroke_width(2);
                    area.draw(&PathElement::new(closed, edge))?;
                }
            }
        }
        Ok(())
    }
}

fn nearness(at: &Pose) -> f64 {
    at.translation.dot(VIEW_DIRECTION)
}

fn shaded(color: RGBColor, light: f64) -> RGBColor {
    let share = 0.72 + 0.28 * light.clamp(0.0, 1.0);
    let part = |part: u8| (f64::from(part) * share).round() as u8;
    RGBColor(part(color.0), part(color.1), part(color.2))
}

/// Draws solids so that each covers those behind it. If two interlock, they keep the given order.
pub fn draw(
    area: &Area<'_>,
    projection: &Projection,
    solids: &[Solid],
) -> Result<(), DrawingError> {
    let mut left: Vec<(&Solid, (Vector, Vector))> =
        solids.iter().map(|solid| (solid, solid.extent())).collect();
    while !left.is_empty() {
        let hides_nothing = |&at: &usize| {
            let behind = |other: &(&Solid, _)| is_behind(other.1, left[at].1);
            !left.iter().any(behind)
        };
        let next = (0..left.len()).find(hides_nothing).unwrap_or(0);
        let (solid, _) = left.remove(next);
        solid.draw(area, projection)?;
    }
    Ok(())
}

/// True if a plane separates two boxes and the first is on the side away from the eye.
fn is_behind((low, high): (Vector, Vector), (other_low, other_high): (Vector, Vector)) -> bool {
    let behind = high.x <= other_low.x || low.y >= other_high.y || high.z <= other_low.z;
    let before = low.x >= other_high.x || high.y <= other_low.y || low.z >= other_high.z;
    behind && !before
}
