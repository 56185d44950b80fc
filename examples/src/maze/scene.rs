//! The maze, the body, and their collision check.

use nalgebra::{UnitComplex, Vector2};
use parry2d_f64::{
    math::{Pose, Vector},
    query::details::{distance_support_map_support_map, intersection_test_cuboid_cuboid},
    shape::Cuboid,
};

use crate::planning::{
    path::{TOUCHING, Verify},
    problem::{Problem, Setting},
};

/// Cells of size 1. The drawn lines are walls.
const MAZE: &str = "\
+--+--+--+--+--+--+--+--+--+--+--+--+
|  |              |  |              |
+  +--+  +--+--+  +  +  +--+--+  +--+
|  |     |        |     |     |     |
+  +  +--+  +--+--+--+--+  +  +--+  +
|  |     |                 |  |     |
+  +--+  +--+--+--+--+--+--+  +  +--+
|        |        |           |     |
+--+--+--+  +  +--+  +--+--+--+--+  +
|  |     |  |        |           |  |
+  +  +  +  +--+--+--+--+--+  +  +  +
|     |  |  |     |           |     |
+--+--+  +  +  +  +  +--+--+--+--+  +
|        |     |     |        |     |
+  +--+--+--+--+--+--+  +  +--+  +--+
|                       |           |
+--+--+--+--+--+--+--+--+--+--+--+--+";

/// Half of a wall's thickness.
const HALF_WALL: f64 = 0.05;

/// The body, a C that opens to the right: its outer width, its height and its thickness.
const BODY: (f64, f64, f64) = (0.66, 0.66, 0.16);

/// Positions are in cells, angles in radians. A body that turns by dθ moves each of its points by at most r·dθ, where r
/// ≈ 0.42 is the distance of its corners from its centre. With the weight r², a distance is about the farthest that a
/// point of the body moves, for rotation and for translation. So one resolution suits both.
const SPACE: &str = "R2*SO2:0.18";

/// The distance between the states at which a motion is checked. Between two of them, a point of the body is at most √2
/// · [`RESOLUTION`] / 2 away from its position in the nearer one. The factor √2 arises because the squares of the
/// distances in position and angle are added.
const RESOLUTION: f64 = 0.015;

/// The margin by which the checked body is thicker on all sides. A motion that is free for the thicker body is free
/// between the checked states too.
const MARGIN: f64 = RESOLUTION * std::f64::consts::FRAC_1_SQRT_2;

/// A box in the plane.
pub struct Block {
    /// Its centre.
    pub center: Vector,
    /// Half of its sides.
    pub half: Vector,
}

impl Block {
    fn between(low: (f64, f64), high: (f64, f64)) -> Block {
        Block {
            center: Vector::new((low.0 + high.0) / 2.0, (low.1 + high.1) / 2.0),
            half: Vector::new((high.0 - low.0) / 2.0, (high.1 - low.1) / 2.0),
        }
    }

    fn shape(&self) -> Cuboid {
        Cuboid::new(self.half)
    }

    fn with_margin(&self) -> Cuboid {
        Cuboid::new(self.half + Vector::splat(MARGIN))
    }

    fn pose(&self) -> Pose {
        Pose::from_translation(self.center)
    }
}

/// The maze and the body in it.
pub struct Maze {
    setting: Setting,
    walls: Vec<Block>,
    body: Vec<Block>,
    /// The distance that the body reaches from its centre, with its margin.
    radius: f64,
}

impl Maze {
    /// The whole maze, from the upper left to the lower right corner, with a rotation.
    pub fn new() -> Maze {
        Maze::between((0, 0), (11, 7))
    }

    /// The problem of moving between two cells, each given as column and row.
    pub fn between(start: (u8, u8), goal: (u8, u8)) -> Maze {
        let (width, height) = (
            MAZE.find('\n').unwrap_or_default() / 3,
            MAZE.lines().count() / 2,
        );
        let middle = |(column, row): (u8, u8), angle: f64| {
            let y = height as f64 - 0.5 - f64::from(row);
            vec![f64::from(column) + 0.5, y, angle]
        };
        let (w, h, thick) = (BODY.0 / 2.0, BODY.1 / 2.0, BODY.2);
        Maze {
            setting: Setting {
                space: SPACE.parse().expect("the text of a space"),
                bounds: vec![(0.0, width as f64), (0.0, height as f64)],
                start: middle(start, 0.0),
                // The canonical angle of a half turn is −π.
                goal: middle(goal, -std::f64::consts::PI),
            },
            walls: walls(height),
            body: vec![
                Block::between((-w, -h), (thick - w, h)),
                Block::between((thick - w, h - thick), (w, h)),
                Block::between((thick - w, -h), (w, thick - h)),
            ],
            radius: (w + MARGIN).hypot(h + MARGIN),
        }
    }

    /// The walls.
    pub fn walls(&self) -> &[Block] {
        &self.walls
    }

    /// The corners of the body in a state, in cyclic order.
    pub fn outline(&self, state: &[f64]) -> Vec<(f64, f64)> {
        let pose = pose(state);
        let (w, h, thick) = (BODY.0 / 2.0, BODY.1 / 2.0, BODY.2);
        let corners = [
            (w, h),
            (-w, h),
            (-w, -h),
            (w, -h),
            (w, thick - h),
            (thick - w, thick - h),
            (thick - w, h - thick),
            (w, h - thick),
        ];
        let place = |(x, y)| pose.transform_point(Vector::new(x, y));
        corners.map(place).map(|point| (point.x, point.y)).to_vec()
    }

    /// True if the bounding circle of the body at this position reaches a wall.
    fn is_near(&self, place: Vector, wall: &Block) -> bool {
        let outside = (place - wall.center).abs() - wall.half;
        outside.x.max(outside.y) < self.radius
    }
}

impl Problem for Maze {
    fn setting(&self) -> &Setting {
        &self.setting
    }

    fn is_free(&self, state: &[f64]) -> bool {
        let pose = pose(state);
        let near = |wall: &&Block| self.is_near(pose.translation, wall);
        self.walls.iter().filter(near).all(|wall| {
            let there = pose.inv_mul(&wall.pose());
            self.body.iter().all(|part| {
                let from_part = Pose::from_translation(-part.center) * there;
                !intersection_test_cuboid_cuboid(&from_part, &part.with_margin(), &wall.shape())
            })
        })
    }

    fn resolution(&self) -> f64 {
        RESOLUTION
    }

    fn checks_per_node(&self) -> usize {
        2
    }
}

impl Verify for Maze {
    /// nalgebra interpolates the state. The state is free if GJK finds each part away from each wall. The planner
    /// instead uses separating axes, and skips walls that its bounding circle does not reach.
    fn is_free_between(&self, a: &[f64], b: &[f64], t: f64) -> bool {
        let (from, to) = (Vector2::new(a[0], a[1]), Vector2::new(b[0], b[1]));
        let place = from.lerp(&to, t);
        let turned = UnitComplex::new(a[2]).slerp(&UnitComplex::new(b[2]), t);
        let pose = Pose::new(Vector::new(place.x, place.y), turned.angle());
        self.walls.iter().all(|wall| {
            self.body.iter().all(|part| {
                let there = (pose * part.pose()).inv_mul(&wall.pose());
                distance_support_map_support_map(&there, &part.shape(), &wall.shape()) > TOUCHING
            })
        })
    }
}

fn pose(state: &[f64]) -> Pose {
    Pose::new(Vector::new(state[0], state[1]), state[2])
}

/// The walls of the maze, each of maximal length.
fn walls(height: usize) -> Vec<Block> {
    let lines: Vec<&[u8]> = MAZE.lines().map(str::as_bytes).collect();
    let is_wall = |line: usize, column: usize| {
        let character = lines.get(line).and_then(|line| line.get(column));
        character.is_some_and(|character| matches!(character, b'-' | b'|'))
    };
    let mut walls = Vec::new();
    let mut add = |x: (usize, usize), y: (usize, usize)| {
        let place = |at: usize, half: f64| at as f64 + half;
        let top = height as f64;
        walls.push(Block::between(
            (place(x.0, -HALF_WALL), top - place(y.1, HALF_WALL)),
            (place(x.1, HALF_WALL), top - place(y.0, -HALF_WALL)),
        ));
    };
    let (rows, columns) = (lines.len() / 2, lines[0].len() / 3);
    for row in 0..=rows {
        for (first, last) in runs((0..columns).map(|column| is_wall(2 * row, 3 * column + 1))) {
            add((first, last), (row, row));
        }
    }
    for column in 0..=columns {
        for (first, last) in runs((0..rows).map(|row| is_wall(2 * row + 1, 3 * column))) {
            add((column, column), (first, last));
        }
    }
    walls
}

/// The beginnings and ends of the runs of true.
fn runs(of: impl Iterator<Item = bool>) -> Vec<(usize, usize)> {
    let (mut runs, mut begun) = (Vec::new(), None);
    for (at, is) in of.chain([false]).enumerate() {
        match (is, begun) {
            (true, None) => begun = Some(at),
            (false, Some(first)) => {
                runs.push((first, at));
                begun = None;
            }
            _ => {}
        }
    }
    runs
}
