//! The collision checks of the maze and the room: the planner's, and the finer one that verifies paths.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold_examples::{
    bodies::scene::Room,
    maze::scene::Maze,
    planning::{
        error::PlanningError,
        path::{self, Verify},
        problem::Problem,
        sampling,
    },
};

use crate::planning::small;

#[test]
fn a_path_through_a_wall_is_found_out() {
    let problem = Maze::new();
    let through = [problem.start().to_vec(), problem.goal().to_vec()];
    let found = path::verify(&problem, &through);
    assert!(matches!(
        found,
        Err(PlanningError::Collision { segment: 0 })
    ));
}

/// True if the finer check finds a state free.
fn is_free_by_other_code(problem: &impl Verify, state: &[f64]) -> bool {
    problem.is_free_between(state, state, 0.0)
}

#[test]
fn the_finer_check_of_the_maze_tells_a_touch_from_a_gap() {
    let problem = Maze::new();
    // The left wall ends at 0.05, and the body extends 0.33 from its middle.
    assert!(!is_free_by_other_code(&problem, &[0.38, 7.5, 0.0]));
    assert!(is_free_by_other_code(&problem, &[0.381, 7.5, 0.0]));
    // The planner keeps a margin.
    assert!(!problem.is_free(&[0.381, 7.5, 0.0]));
    // Turned by an eighth, the body extends 0.467 to each side, more than the corridor.
    let turned = std::f64::consts::FRAC_PI_4;
    assert!(!is_free_by_other_code(&problem, &[0.5, 7.5, turned]));
    assert!(is_free_by_other_code(&problem, &[0.5, 7.5, 0.0]));
}

#[test]
fn the_finer_check_of_the_room_tells_a_touch_from_a_gap() {
    let problem = Room::new();
    let with = |body: usize, place: [f64; 3]| {
        let mut state = problem.start().to_vec();
        state[7 * body..7 * body + 3].copy_from_slice(&place);
        is_free_by_other_code(&problem, &state)
    };
    // Two upright bodies, each 0.1 deep to both sides; the first is at its start.
    assert!(!with(1, [1.2, 1.4 + 0.2, 1.3]));
    assert!(with(1, [1.2, 1.4 + 0.201, 1.3]));
    // A pillar begins at 4.0, and the upper bar reaches 0.4 to its side.
    assert!(!with(0, [3.6, 0.5, 3.0]));
    assert!(with(0, [3.599, 0.5, 3.0]));
    // The lower bar reaches 0.41 down to the floor, and the upper one 0.41 up to the ceiling.
    assert!(!with(0, [1.2, 1.4, 0.409]) && with(0, [1.2, 1.4, 0.411]));
    assert!(!with(0, [1.2, 1.4, 5.591]) && with(0, [1.2, 1.4, 5.589]));
}

/// Each state that the planner finds free is free, with all states within half a resolution of it.
fn free_is_free(problem: &impl Verify, states: usize) {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let (space, mut free) = (problem.space(), 0);
    let mut moved = vec![0.0; space.coordinates()];
    for _ in 0..states {
        let state = sampling::uniform(space, problem.bounds(), &mut rng);
        if !problem.is_free(&state) {
            continue;
        }
        free += 1;
        assert!(problem.is_free_between(&state, &state, 0.0));
        let far = sampling::uniform(space, problem.bounds(), &mut rng);
        let share = 0.5 * problem.resolution() / space.distance(&state, &far);
        space.interpolate(&state, &far, share * rng.random::<f64>().sqrt(), &mut moved);
        assert!(problem.is_free_between(&moved, &moved, 0.0));
    }
    assert!((states / 1000..states).contains(&free), "{free}");
}

#[test]
fn free_states_in_the_maze_have_free_surroundings() {
    let problem = small();
    assert!(problem.is_free(problem.start()) && problem.is_free(problem.goal()));
    free_is_free(&problem, 20_000);
}

#[test]
fn free_states_in_the_room_have_free_surroundings() {
    let problem = Room::new();
    assert!(problem.is_free(problem.start()) && problem.is_free(problem.goal()));
    // The second body is at the place of the first.
    let mut two = problem.start().to_vec();
    two.copy_within(0..7, 7);
    assert!(!problem.is_free(&two) && !problem.is_free_between(&two, &two, 0.0));
    free_is_free(&problem, 3000);
}
