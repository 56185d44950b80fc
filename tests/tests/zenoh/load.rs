//! `wayfold load` over Zenoh.

use std::process::{Command, Output};

use serde_json::Value;
use wayfold::Index;
use wayfold_index::Space;

use crate::robot::{Robot, server};

fn load(locator: &str, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cli-process"));
    command.args([
        "load",
        "arm",
        "--face",
        "zenoh",
        "--locator",
        locator,
        "--json",
    ]);
    command.args(arguments).output().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_load_over_zenoh_stores_its_points_and_removes_them() {
    let (_server, locator) = server();
    let space: Space = "R2*SO2".parse().unwrap();
    let robot = Robot::connect(&locator).await;
    let index = Index::shared_over_zenoh(robot.session.clone(), "wayfold/v1", "arm");
    let index = index.create(&space).open().unwrap();
    index.insert([0.1, 0.2, 0.3]).unwrap();
    index.flush().unwrap();

    let arguments = [
        "--calls",
        "300",
        "--workers",
        "2",
        "--batch",
        "3",
        "--seed",
        "8",
    ];
    let run = load(&locator, &arguments);
    let errors = String::from_utf8_lossy(&run.stderr);
    let result: Value = serde_json::from_slice(&run.stdout).expect(&errors);
    assert_eq!(result["total"]["answered"], 300, "{result}");
    let inserted = &result["points"]["inserted"];
    assert!(inserted.as_u64().unwrap() > 0);
    assert_eq!(&result["points"]["removed"], inserted);
    assert_eq!(result["points"]["after"], 1);

    let kept = load(&locator, &[&arguments[..], &["--keep"]].concat());
    let kept: Value = serde_json::from_slice(&kept.stdout).unwrap();
    assert_eq!(&kept["points"]["inserted"], inserted);
    // A copy that is opened now has read all points that the server holds.
    let copy = Index::shared_over_zenoh(robot.session.clone(), "wayfold/v1", "arm");
    let copy = copy.open().unwrap();
    assert_eq!(copy.len().unwrap() as u64, 1 + inserted.as_u64().unwrap());
}
