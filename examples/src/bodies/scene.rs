//! The room, the eight bodies, and their collision check.

use parry3d_f64::{
    math::{Pose, Vector},
    query::details::{distance_support_map_support_map, intersection_test_cuboid_cuboid},
    shape::Cuboid,
};
use wayfold::Space;

use crate::planning::{
    body::{self, Block, ROTATION_WEIGHT, block, is_inside, margin, pose},
    path::{TOUCHING, Verify},
    pose::between,
    problem::{Problem, Setting},
};

/// The number of bodies.
pub const BODIES: usize = 8;

/// The number of coordinates of one body's pose.
const POSE: usize = 7;

/// The room's length, width and height.
pub const ROOM: [f64; 3] = [13.0, 8.0, 6.0];

/// The two bars of a body, which form a T: the centre and half of the sides of each.
const PARTS: [([f64; 3], [f64; 3]); 2] = [
    ([0.0, 0.0, 0.31], [0.4, 0.1, 0.1]),
    ([0.0, 0.0, -0.1], [0.1, 0.1, 0.31]),
];

/// The distance of a body's farthest corner from its centre.
const RADIUS: f64 = 0.59;

/// The distance between the states at which a motion is checked.
const RESOLUTION: f64 = 0.08;

/// Pillars.
pub const OBSTACLES: [Block; 3] = [
    ([6.1, 3.6, 0.0], [6.9, 4.4, 6.0]),
    ([4.0, 0.0, 0.0], [4.6, 0.9, 6.0]),
    ([8.4, 7.1, 0.0], [9.0, 8.0, 6.0]),
];

/// The problem: four bodies at each end of the room change places with those at the other end.
pub struct Room {
    setting: Setting,
    margin: f64,
}

impl Room {
    /// The scene with all eight bodies.
    pub fn new() -> Room {
        let text = format!("(R3*SO3:{ROTATION_WEIGHT})^{BODIES}");
        let space: Space = text.parse().expect("the text of a space");
        let margin = margin(RADIUS, RESOLUTION);
        let inside = RADIUS + margin;
        let bounds = ROOM.map(|side| (inside, side - inside));
        let place = |body: usize| {
            let (side, corner) = (body / 4, body % 4);
            let x = [1.2, ROOM[0] - 1.2][side];
            let (y, z) = (
                [1.4, ROOM[1] - 1.4][corner % 2],
                [1.3, ROOM[2] - 1.3][corner / 2],
            );
            [x, y, z]
        };
        let row = |other: usize| {
            let poses = (0..BODIES).flat_map(|body| {
                let [x, y, z] = place((body + other) % BODIES);
                // The body makes a quarter turn about x.
                let turned = if other == 0 {
                    0.0
                } else {
                    std::f64::consts::FRAC_1_SQRT_2
                };
                [x, y, z, turned, 0.0, 0.0, (1.0 - turned * turned).sqrt()]
            });
            let mut row: Vec<f64> = poses.collect();
            let canonical = space.canonicalize(&mut row);
            assert!(canonical.is_ok(), "{row:?} is a state");
            row
        };
        Room {
            setting: Setting {
                bounds: bounds.repeat(BODIES),
                start: row(0),
                goal: row(4),
                space,
            },
            margin,
        }
    }
}

/// The bars of a body: their poses in it and their shapes, thicker by the margin on all sides.
pub fn parts(margin: f64) -> [(Pose, Cuboid); 2] {
    body::parts(PARTS, margin)
}

/// The poses of the bodies in a state.
pub fn poses(state: &[f64]) -> Vec<Pose> {
    state.chunks_exact(POSE).map(pose).collect()
}

impl Problem for Room {
    fn setting(&self) -> &Setting {
        &self.setting
    }

    /// Tests pairs of boxes for a separating axis, where bodies can reach anything. The bounds of the space keep bodies
    /// away from walls, floor and ceiling.
    fn is_free(&self, state: &[f64]) -> bool {
        let (poses, parts, pillars) = (poses(state), parts(self.margin), OBSTACLES.map(block));
        let bounding_radius = RADIUS + self.margin * 3.0_f64.sqrt();
        let hits = |pose: &Pose, other: &Pose, shape: &Cuboid| {
            parts.iter().any(|(at, part)| {
                intersection_test_cuboid_cuboid(&(*pose * *at).inv_mul(other), part, shape)
            })
        };
        poses.iter().enumerate().all(|(body, pose)| {
            let clear_of_pillars = pillars.iter().all(|(place, pillar)| {
                let outside = (pose.translation - place.translation).abs() - pillar.half_extents;
                let far = outside.max(Vector::ZERO).length() >= bounding_radius;
                far || !hits(pose, place, pillar)
            });
            clear_of_pillars
                && poses[..body].iter().all(|other| {
                    let far =
                        (pose.translation - other.translation).length() >= 2.0 * bounding_radius;
                    far || !parts
                        .iter()
                        .any(|(at, part)| hits(pose, &(*other * *at), part))
                })
        })
    }

    fn resolution(&self) -> f64 {
        RESOLUTION
    }

    fn checks_per_node(&self) -> usize {
        4
    }
}

impl Verify for Room {
    /// nalgebra interpolates the state. The state is free if the corners of each bar are inside the room, and if GJK
    /// finds the bar away from each pillar and from each bar of another body. The planner instead uses separating axes,
    /// and skips everything that its bounding spheres do not reach.
    fn is_free_between(&self, a: &[f64], b: &[f64], t: f64) -> bool {
        let (bars, pillars) = (parts(0.0), OBSTACLES.map(block));
        let apart = |a: &Pose, shape: &Cuboid, b: &Pose, other: &Cuboid| {
            distance_support_map_support_map(&a.inv_mul(b), shape, other) > TOUCHING
        };
        let rows = a.chunks_exact(POSE).zip(b.chunks_exact(POSE));
        let bodies: Vec<[(Pose, Cuboid); 2]> = rows
            .map(|(a, b)| {
                let pose = between(a, b, t);
                bars.map(|(at, bar)| (pose * at, bar))
            })
            .collect();
        bodies.iter().enumerate().all(|(body, bars)| {
            bars.iter().all(|(at, bar)| {
                let mut others = bodies[..body].iter().flatten().chain(&pillars);
                is_inside(at, bar, ROOM)
                    && others.all(|(place, other)| apart(at, bar, place, other))
            })
        })
    }
}
