//! The rows that `--json` writes, the same for each program and each kind of planner.

use std::{collections::BTreeSet, fs, process::Command};

use serde_json::Value;

const KEYS: [&str; 13] = [
    "planner",
    "source",
    "workers",
    "seed",
    "nodes",
    "total_s",
    "search_s",
    "insert_s",
    "check_s",
    "flush_s",
    "busy_share",
    "checks",
    "path_lengths",
];

const MAZE: &str = env!("CARGO_BIN_EXE_maze");
const BODIES: &str = env!("CARGO_BIN_EXE_bodies");
const RIGID: &str = env!("CARGO_BIN_EXE_rigid");

/// Runs a program in a directory of its own, and checks its only row: planner, source, workers, seed, the number of
/// paths, and consistent figures.
fn writes(program: &str, arguments: &str, expected: (&str, &str, u64, u64), paths: usize) {
    let directory = tempfile::tempdir().unwrap();
    let mut command = Command::new(program);
    let command = command
        .args(arguments.split(' '))
        .args(["--json", "rows.json"]);
    let output = command.current_dir(&directory).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.success(), paths > 0, "{arguments}: {errors}");
    let text = fs::read(directory.path().join("rows.json")).unwrap();
    let rows: Vec<Value> = serde_json::from_slice(&text).unwrap();
    let [row] = &rows[..] else {
        panic!("{arguments}: {rows:?}");
    };
    let keys: BTreeSet<&str> = row
        .as_object()
        .unwrap()
        .keys()
        .map(String::as_str)
        .collect();
    assert_eq!(keys, BTreeSet::from(KEYS));
    let text = |key: &str| row[key].as_str().unwrap();
    let whole = |key: &str| row[key].as_u64().unwrap();
    let of = (
        text("planner"),
        text("source"),
        whole("workers"),
        whole("seed"),
    );
    assert_eq!(of, expected);
    let seconds = |key: &str| row[key].as_f64().unwrap();
    let parts = ["search_s", "insert_s", "check_s"].map(seconds);
    assert!(parts.iter().all(|part| *part > 0.0), "{row}");
    // The parts are sums over all workers.
    assert!(
        parts.iter().sum::<f64>() <= seconds("total_s") * expected.2 as f64,
        "{row}"
    );
    assert!(
        whole("nodes") > 1 && whole("checks") > whole("nodes"),
        "{row}"
    );
    let lengths = row["path_lengths"].as_array().unwrap();
    assert_eq!(lengths.len(), paths);
    assert!(lengths.iter().all(|length| length.as_f64().unwrap() > 0.0));
}

#[test]
fn maze_writes_a_row() {
    let of = ("RRTConCon", "memory", 1, 3);
    writes(MAZE, "--source memory --seed 3", of, 1);
}

#[test]
fn a_tree_of_rrt_star_writes_a_row() {
    let of = ("RRT*", "memory", 1, 3);
    // So few samples find no path, which is an error.
    writes(MAZE, "--source memory --seed 3 --rrt-star 2000", of, 0);
}

#[test]
fn bodies_writes_a_row() {
    let of = ("RRTConCon", "memory", 1, 4);
    writes(BODIES, "--source memory --seed 4", of, 1);
}

#[test]
fn workers_that_share_trees_write_a_row_together() {
    let of = ("RRTConCon", "shared", 2, 1);
    writes(BODIES, "--workers 2", of, 1);
}

#[test]
fn workers_that_share_a_roadmap_write_a_row_together() {
    let of = ("PRM*", "shared", 2, 1);
    writes(RIGID, "--workers 2 --milestones 100", of, 3);
}

#[test]
fn workers_that_stop_at_the_solution_write_a_row_together() {
    let of = ("PRM*", "remote", 1, 1);
    let arguments = "--until-solved --workers 1 --source remote --runs 1";
    writes(RIGID, arguments, of, 3);
}
