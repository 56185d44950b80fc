//! The library `rigid-checks` gives other languages the same answers as the program `rigid`.

#![expect(
    unsafe_code,
    reason = "the functions are those that other languages call"
)]

use std::{ffi::CStr, ptr};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use wayfold_examples::{
    planning::{
        path::{self, Verify},
        problem::Problem,
        sampling,
    },
    rigid::{
        abi::{
            FREE, NO_STATE, NOT_FREE, rigid_canonicalize, rigid_distance, rigid_is_free,
            rigid_is_free_path, rigid_is_free_way, rigid_problem,
        },
        scene::Rooms,
    },
};

fn is_free(row: &[f64]) -> i32 {
    // Safety: the address and the length of a row.
    unsafe { rigid_is_free(row.as_ptr(), row.len()) }
}

fn is_free_way(a: &[f64], b: &[f64], checks: &mut u64) -> i32 {
    // Safety: the addresses and the length of rows.
    unsafe { rigid_is_free_way(a.as_ptr(), b.as_ptr(), a.len(), checks) }
}

fn is_free_path(rows: &[f64], count: usize) -> i32 {
    // Safety: the address of as many rows of this length.
    unsafe { rigid_is_free_path(rows.as_ptr(), count, rows.len() / count) }
}

#[test]
fn the_finer_check_of_paths_tells_a_touch_from_a_gap() {
    let scene = Rooms::new();
    let upright = |place: [f64; 3]| [&place[..], &[0.0, 0.0, 0.0, 1.0]].concat();
    let is_free = |place| {
        let state = upright(place);
        scene.is_free_between(&state, &state, 0.0)
    };
    // In the door, which begins at 0.6 and ends at a height of 2.4: the chair extends 0.4 to the side and 0.85 up.
    assert!(!is_free([3.3, 1.0, 1.05]) && is_free([3.3, 1.001, 1.05]));
    assert!(!is_free([3.3, 1.6, 1.55]) && is_free([3.3, 1.6, 1.549]));
    // The planner keeps a margin.
    assert!(!scene.is_free(&upright([3.3, 1.001, 1.05])));
    // Its legs extend 0.85 down to the floor.
    assert!(!is_free([1.2, 1.4, 0.849]) && is_free([1.2, 1.4, 0.851]));
    let way = |y| [[2.5, y, 1.05], [4.2, y, 1.05]].map(upright);
    assert!(path::verify(&scene, &way(1.001)).is_ok());
    assert!(path::verify(&scene, &way(0.999)).is_err());
}

#[test]
fn states_and_motions_are_judged_as_by_the_scene() {
    let scene = Rooms::new();
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let states: Vec<Vec<f64>> = (0..800)
        .map(|_| sampling::uniform(scene.space(), scene.bounds(), &mut rng))
        .collect();
    for state in &states {
        assert_eq!(is_free(state), i32::from(scene.is_free(state)), "{state:?}");
    }
    let free: Vec<_> = states.iter().filter(|state| scene.is_free(state)).collect();
    assert!(free.len() > 40 && free.len() < 760);

    let (mut reported, mut expected, mut ways) = (0, 0, [0, 0]);
    for pair in free.windows(2) {
        let [a, b] = pair else { unreachable!() };
        // Some motions of this length are free.
        let mut near = vec![0.0; a.len()];
        scene.space().interpolate(a, b, 0.1, &mut near);
        let judged = scene.is_free_way(a, &near, &mut expected);
        assert_eq!(is_free_way(a, &near, &mut reported), i32::from(judged));
        assert_eq!(reported, expected, "as many checks");
        ways[usize::from(judged)] += 1;

        // Safety: rows of one length.
        let distance = unsafe { rigid_distance(a.as_ptr(), b.as_ptr(), a.len()) };
        assert_eq!(
            distance.to_bits(),
            scene.space().distance(a, b).to_bits(),
            "bit for bit"
        );
        let verified = path::verify(&scene, &[a.to_vec(), near.clone()]).is_ok();
        let rows = [&a[..], &near].concat();
        assert_eq!(is_free_path(&rows, 2), i32::from(verified));
    }
    assert!(ways[0] > 10 && ways[1] > 10, "both are found: {ways:?}");
}

#[test]
fn the_problem_is_described_completely() {
    let scene = Rooms::new();
    // Safety: it is never freed.
    let text = unsafe { CStr::from_ptr(rigid_problem()) };
    let problem: serde_json::Value = serde_json::from_str(text.to_str().unwrap()).unwrap();
    assert_eq!(problem["space"], scene.space().to_string());
    assert_eq!(problem["coordinates"], 7);
    assert_eq!(problem["bounds"], serde_json::json!(scene.bounds()));
    assert_eq!(problem["resolution"], scene.resolution());
    let tasks = problem["tasks"].as_array().unwrap();
    assert_eq!(tasks.len(), scene.tasks().len());
    for (reported, task) in tasks.iter().zip(scene.tasks()) {
        assert_eq!(reported["start"], serde_json::json!(task.start));
        assert_eq!(reported["goal"], serde_json::json!(task.goal));
        assert_eq!(is_free(&task.start), FREE);
    }
}

#[test]
fn rows_become_canonical() {
    let canonicalize = |row: &mut [f64]| {
        // Safety: the address and the length of a row.
        unsafe { rigid_canonicalize(row.as_mut_ptr(), row.len()) }
    };
    let mut row = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, -1.0];
    assert_eq!(canonicalize(&mut row), FREE);
    assert_eq!(row, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]);
    assert_eq!(canonicalize(&mut [0.0; 7]), NO_STATE, "no rotation");
}

#[test]
fn invalid_states_are_refused() {
    let mut row = vec![5.0, 3.0, 2.0, 0.0, 0.0, 0.0, 1.0];
    assert_ne!(is_free(&row), NO_STATE);
    assert_eq!(is_free(&row[..6]), NO_STATE, "too short");
    let mut checks = 5;
    // Safety: null is allowed everywhere.
    unsafe {
        let (none, some) = (ptr::null::<f64>(), row.as_ptr());
        assert_eq!(rigid_is_free(none, 7), NO_STATE);
        assert_eq!(rigid_is_free_way(none, some, 7, &mut checks), NO_STATE);
        assert_eq!(rigid_is_free_way(some, none, 7, &mut checks), NO_STATE);
        assert!(rigid_distance(none, some, 7).is_nan());
        assert_eq!(rigid_is_free_path(none, 1, 7), NO_STATE);
        assert_eq!(rigid_canonicalize(ptr::null_mut(), 7), NO_STATE);
        // The count is optional.
        let way = rigid_is_free_way(some, some, 7, ptr::null_mut());
        assert_eq!(way, FREE);
    }
    row[3] = f64::NAN;
    assert_eq!(is_free(&row), NO_STATE);
    assert_eq!(is_free_way(&row, &row, &mut checks), NO_STATE);
    assert_eq!(is_free_path(&row, 1), NO_STATE);
    assert_eq!(checks, 5);
    // In the shelf.
    assert_eq!(is_free(&[0.8, 5.4, 1.0, 0.0, 0.0, 0.0, 1.0]), NOT_FREE);
}
