//! The interface between a scene and a planner.

use wayfold::Space;

/// The part of a problem that is data.
pub struct Setting {
    /// The space, whose metric defines the neighbours.
    pub space: Space,
    /// The bounds of all real coordinates, in row order; angles and rotations have none.
    pub bounds: Vec<(f64, f64)>,
    /// The start, a canonical row.
    pub start: Vec<f64>,
    /// The goal, a canonical row.
    pub goal: Vec<f64>,
}

/// A motion planning problem: to find a path from `start` to `goal` through the free states of a space.
pub trait Problem {
    /// Its data.
    fn setting(&self) -> &Setting;

    /// The space of its setting.
    fn space(&self) -> &Space {
        &self.setting().space
    }

    /// The bounds of its setting.
    fn bounds(&self) -> &[(f64, f64)] {
        &self.setting().bounds
    }

    /// The start of its setting.
    fn start(&self) -> &[f64] {
        &self.setting().start
    }

    /// The goal of its setting.
    fn goal(&self) -> &[f64] {
        &self.setting().goal
    }

    /// True if a canonical state is free of collisions.
    fn is_free(&self, state: &[f64]) -> bool;

    /// The maximum distance, in the metric, between the states at which a motion is checked.
    fn resolution(&self) -> f64;

    /// The number of such states between two nodes of a motion.
    fn checks_per_node(&self) -> usize;

    /// True if a motion between free states is free. The result depends only on the two states and their order. Adds
    /// the number of checked states.
    fn is_free_way(&self, a: &[f64], b: &[f64], checks: &mut u64) -> bool {
        let steps = (self.space().distance(a, b) / self.resolution()).ceil() as usize;
        let mut state = vec![0.0; self.space().coordinates()];
        // The middle is checked first, then the middles of the halves, so that obstacles are found early.
        let mut stride = steps.next_power_of_two() / 2;
        while stride > 0 {
            for step in (stride..steps).step_by(2 * stride) {
                let share = step as f64 / steps as f64;
                self.space().interpolate(a, b, share, &mut state);
                *checks += 1;
                if !self.is_free(&state) {
                    return false;
                }
            }
            stride /= 2;
        }
        true
    }
}
