//! Three rooms, a chair that is carried through them, and its collision check.

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

/// Length, depth and height of all three rooms together.
pub const SIDES: [f64; 3] = [10.0, 6.0, 4.0];

/// The wall with a door.
pub const DOOR_WALL: [Block; 3] = [
    ([3.2, 0.0, 0.0], [3.45, 0.6, 4.0]),
    ([3.2, 2.6, 0.0], [3.45, 6.0, 4.0]),
    ([3.2, 0.6, 2.4], [3.45, 2.6, 4.0]),
];

/// The wall with a window.
pub const WINDOW_WALL: [Block; 4] = [
    ([6.6, 0.0, 0.0], [6.85, 3.2, 4.0]),
    ([6.6, 5.4, 0.0], [6.85, 6.0, 4.0]),
    ([6.6, 3.2, 0.0], [6.85, 5.4, 1.1]),
    ([6.6, 3.2, 3.2], [6.85, 5.4, 4.0]),
];

/// A shelf, a table, a beam and a pillar.
pub const FURNITURE: [Block; 9] = [
    ([0.0, 4.9, 0.0], [1.7, 6.0, 2.2]),
    ([4.4, 3.4, 0.9], [5.7, 5.2, 1.02]),
    ([4.45, 3.45, 0.0], [4.6, 3.6, 0.9]),
    ([5.5, 3.45, 0.0], [5.65, 3.6, 0.9]),
    ([4.45, 5.0, 0.0], [4.6, 5.15, 0.9]),
    ([5.5, 5.0, 0.0], [5.65, 5.15, 0.9]),
    ([3.45, 1.3, 3.4], [6.6, 1.6, 3.7]),
    ([8.1, 2.6, 0.0], [8.5, 3.0, 4.0]),
    ([9.2, 0.0, 0.0], [10.0, 1.4, 1.2]),
];

/// Seat, back and legs of the chair: the centre and half of the sides of each.
const PARTS: [([f64; 3], [f64; 3]); 6] = [
    ([0.0, 0.0, -0.10], [0.40, 0.40, 0.05]),
    ([0.0, 0.35, 0.40], [0.40, 0.05, 0.45]),
    ([-0.35, -0.35, -0.50], [0.05, 0.05, 0.35]),
    ([0.35, -0.35, -0.50], [0.05, 0.05, 0.35]),
    ([-0.35, 0.35, -0.50], [0.05, 0.05, 0.35]),
    ([0.35, 0.35, -0.50], [0.05, 0.05, 0.35]),
];

/// The distance of the chair's farthest corner from its centre.
const RADIUS: f64 = 1.03;

/// The distance between the states at which a motion is checked.
const RESOLUTION: f64 = 0.015;

/// A question to the roadmap: from one state to another.
pub struct Task {
    /// Its name.
    pub name: &'static str,
    /// The start, a canonical row.
    pub start: Vec<f64>,
    /// The goal, a canonical row.
    pub goal: Vec<f64>,
}

/// The problem.
pub struct Rooms {
    setting: Setting,
    obstacles: Vec<(Pose, Cuboid)>,
    tasks: Vec<Task>,
    margin: f64,
}

impl Rooms {
    /// The rooms with all obstacles.
    pub fn new() -> Rooms {
        let text = format!("R3*SO3:{ROTATION_WEIGHT}");
        let space: Space = text.parse().expect("the text of a space");
        // About the axes x, y, z by multiples of a half turn's parts; rows of quaternions are x, y, z, w.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let upright = [0.0, 0.0, 0.0, 1.0];
        let turned = [0.0, 0.0, half, half];
        let upside_down = [1.0, 0.0, 0.0, 0.0];
        let on_its_back = [half, 0.0, 0.0, half];
        let places = [
            ([1.2, 1.4, 1.05], upright),
            ([9.0, 4.6, 1.05], turned),
            ([5.0, 4.3, 2.1], upside_down),
            ([0.85, 5.0, 2.85], on_its_back),
        ];
        let row = |place: usize| {
            let (at, turn) = places[place];
            let mut row = [&at[..], &turn[..]].concat();
            let canonical = space.canonicalize(&mut row);
            assert!(canonical.is_ok(), "{row:?} is a state");
            row
        };
        let task = |name, start, goal| Task {
            name,
            start: row(start),
            goal: row(goal),
        };
        let tasks = vec![
            task("from the front of the first room to the last", 0, 1),
            task("from the table to the last room", 2, 1),
            task("from the top of the shelf to the table", 3, 2),
        ];
        let blocks = DOOR_WALL.iter().chain(&WINDOW_WALL).chain(&FURNITURE);
        Rooms {
            setting: Setting {
                // Nearer to the outer walls, the chair touches them in almost every orientation.
                bounds: SIDES.map(|side| (0.4, side - 0.4)).to_vec(),
                start: tasks[0].start.clone(),
                goal: tasks[0].goal.clone(),
                space,
            },
            obstacles: blocks.copied().map(block).collect(),
            tasks,
            margin: margin(RADIUS, RESOLUTION),
        }
    }

    /// The questions.
    pub fn tasks(&self) -> &[Task] {
        &self.tasks
    }
}

/// The parts of the chair: their poses in it and their shapes, thicker by the margin on all sides.
pub fn parts(margin: f64) -> [(Pose, Cuboid); 6] {
    body::parts(PARTS, margin)
}

impl Problem for Rooms {
    fn setting(&self) -> &Setting {
        &self.setting
    }

    /// Tests pairs of boxes for a separating axis, if the chair can reach the obstacle.
    fn is_free(&self, state: &[f64]) -> bool {
        let pose = pose(state);
        let parts = parts(self.margin).map(|(at, part)| (pose * at, part));
        let within = |at: &Pose, part: &Cuboid| {
            let column = |axis: Vector, half: f64| (at.rotation * axis * half).abs();
            let half = part.half_extents;
            let extent = column(Vector::X, half.x) + column(Vector::Y, half.y);
            let extent = extent + column(Vector::Z, half.z);
            let (low, high) = (at.translation - extent, at.translation + extent);
            low.min_element() >= 0.0 && (Vector::from(SIDES) - high).min_element() >= 0.0
        };
        if !parts.iter().all(|(at, part)| within(at, part)) {
            return false;
        }
        let bounding_radius = RADIUS + self.margin * 3.0_f64.sqrt();
        self.obstacles.iter().all(|(place, block)| {
            let outside = (pose.translation - place.translation).abs() - block.half_extents;
            let far = outside.max(Vector::ZERO).length() > bounding_radius;
            far || !parts
                .iter()
                .any(|(at, part)| intersection_test_cuboid_cuboid(&at.inv_mul(place), part, block))
        })
    }

    fn resolution(&self) -> f64 {
        RESOLUTION
    }

    /// A roadmap has milestones only at the ends of a motion.
    fn checks_per_node(&self) -> usize {
        usize::MAX
    }
}

impl Verify for Rooms {
    /// nalgebra interpolates the state. The state is free if the corners of each part are inside the room, and if GJK
    /// finds the part away from each obstacle. The planner instead uses separating axes, and skips obstacles that its
    /// bounding sphere does not reach.
    fn is_free_between(&self, a: &[f64], b: &[f64], t: f64) -> bool {
        let pose = between(a, b, t);
        parts(0.0).iter().all(|(at, part)| {
            let at = pose * *at;
            is_inside(&at, part, SIDES)
                && self.obstacles.iter().all(|(place, block)| {
                    let there = at.inv_mul(place);
                    distance_support_map_support_map(&there, part, block) > TOUCHING
                })
        })
    }
}
