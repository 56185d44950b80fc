//! What `--json` writes: the same rows by each program, whoever solved the problem.

use std::{collections::BTreeSet, fs, process::Command};

use serde_json::Value;

/// Runs a program in a directory of its own, and returns what it wrote.
fn rows(program: &str, arguments: &[&str]) -> Vec<Value> {
    let directory = tempfile::tempdir().unwrap();
    let mut command = Command::new(program);
    let command = command.args(arguments).args(["--json", "rows.json"]);
    let output = command.current_dir(&directory).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {errors}");
    let text = fs::read(directory.path().join("rows.json")).unwrap();
    serde_json::from_slice(&text).unwrap()
}

/// That a row has what all rows have, and that its numbers fit together; returns planner, source, workers and seed.
fn checked(row: &Value, paths: usize) -> (&str, &str, u64, u64) {
    let keys: BTreeSet<&str> = row
        .as_object()
        .unwrap()
        .keys()
        .map(String::as_str)
        .collect();
    let expected = [
        "planner",
        "source",
        "workers",
        "seed",
        "nodes",
        "total_s",
        "search_s",
        "insert_s",
        "check_s",
        "checks",
        "path_lengths",
    ];
    assert_eq!(keys, BTreeSet::from(expected));
    let seconds = |key: &str| row[key].as_f64().unwrap();
    let workers = row["workers"].as_u64().unwrap();
    let parts = ["search_s", "insert_s", "check_s"].map(seconds);
    assert!(parts.iter().all(|part| *part > 0.0), "{row}");
    assert!(seconds("total_s") > 0.0);
    assert!(row["nodes"].as_u64().unwrap() > 1);
    assert!(row["checks"].as_u64().unwrap() > 1);
    let lengths = row["path_lengths"].as_array().unwrap();
    assert_eq!(lengths.len(), paths);
    assert!(lengths.iter().all(|length| length.as_f64().unwrap() > 0.0));
    let text = |key: &str| row[key].as_str().unwrap();
    (
        text("planner"),
        text("source"),
        workers,
        row["seed"].as_u64().unwrap(),
    )
}

#[test]
fn maze_and_bodies_write_a_row_a_run() {
    for program in [env!("CARGO_BIN_EXE_maze"), env!("CARGO_BIN_EXE_bodies")] {
        let rows = rows(program, &["--source", "forest", "--seed", "3"]);
        let told: Vec<_> = rows.iter().map(|row| checked(row, 1)).collect();
        assert_eq!(told, [("RRTConCon", "forest", 1, 3)]);
    }
}

#[test]
fn workers_that_share_trees_write_a_row_together() {
    let rows = rows(
        env!("CARGO_BIN_EXE_maze"),
        &["--workers", "2", "--source", "server"],
    );
    let told: Vec<_> = rows.iter().map(|row| checked(row, 1)).collect();
    assert_eq!(told, [("RRTConCon", "server", 2, 1)]);
}

#[test]
fn rigid_writes_the_same_rows_whatever_it_is_asked() {
    let program = env!("CARGO_BIN_EXE_rigid");
    let solved = rows(
        program,
        &["--until-solved", "--workers", "2", "--runs", "2"],
    );
    let told: Vec<_> = solved.iter().map(|row| checked(row, 3)).collect();
    assert_eq!(told, [("PRM*", "replica", 2, 1), ("PRM*", "replica", 2, 2)]);

    let built = [
        "--workers",
        "1",
        "--source",
        "server",
        "--milestones",
        "150",
    ];
    let built = rows(program, &built);
    let told: Vec<_> = built.iter().map(|row| checked(row, 3)).collect();
    assert_eq!(told, [("PRM*", "server", 1, 1)]);

    let compared = rows(
        program,
        &["--compare", "--milestones", "150", "--runs", "1"],
    );
    let told: BTreeSet<_> = compared.iter().map(|row| checked(row, 3)).collect();
    let sources = ["brute force", "SIMD scan", "forest", "server", "replica"];
    assert_eq!(
        told,
        BTreeSet::from(sources.map(|source| ("PRM*", source, 1, 1)))
    );
}
