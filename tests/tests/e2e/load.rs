//! A load prints its figures also after its server has died.

use std::process::Command;

use serde_json::Value;
use wayfold_tests::{Process, ProcessOutput, Signal, server};

use crate::metrics::{calls, figures};

/// The most looks at the counts of a server.
const MAX_LOOKS: usize = 20_000;

/// Runs a load with this mix, and kills its server once that has answered a call. Returns what it printed and its report.
fn cut_short(mix: &str, verb: &str) -> (ProcessOutput, String) {
    let mut server = server!("--http", "127.0.0.1:0");
    let pages = server.pages();
    let directory = tempfile::tempdir().unwrap();
    let report = directory.path().join("report.html");
    let wayfold = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cli-process"));
        command.args(["--server", server.uri(), "--timeout", "5s"]);
        command.args(arguments);
        Process::spawn(&mut command)
    };
    let created = wayfold(&["create", "arm", "--space", "R1"]).finish();
    assert!(created.status.success(), "{}", created.stderr);
    let options = [
        "--rate",
        "50",
        "--duration",
        "6s",
        "--fill",
        "0",
        "--json",
        "--mix",
        mix,
    ];
    let report_option = ["--report", report.to_str().unwrap()];
    let load = wayfold(
        &[
            &["load", "arm", "--workers", "1"],
            &options[..],
            &report_option,
        ]
        .concat(),
    );
    let answered = calls("grpc", verb, "arm", "OK");
    // The first calls open the workers.
    let mut looks = 0..MAX_LOOKS;
    while figures(&pages).get(&answered) < Some(&10.0) {
        assert!(looks.next().is_some(), "the load makes no calls");
    }
    server.stop(Signal::Kill);
    let ended = load.finish();
    let report = std::fs::read_to_string(report).unwrap_or_else(|_| panic!("{ended:?}"));
    (ended, report)
}

/// Points of a fill that fails are removed, also if the run has no inserts.
#[test]
fn a_fill_that_fails_leaves_nothing() {
    let server = server!(; ("WAYFOLD_LIMITS__MAX_POINTS_PER_INDEX", "1500"));
    let wayfold = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cli-process"));
        command.args(["--server", server.uri(), "--output", "json"]);
        Process::spawn(command.args(arguments)).finish()
    };
    wayfold(&["create", "arm", "--space", "R1"]);
    let load = [
        "load", "arm", "--mix", "knn=1", "--fill", "2500", "--calls", "1",
    ];
    let refused = wayfold(&load);
    assert!(
        refused.stderr.contains("QUOTA_EXCEEDED"),
        "{}",
        refused.stderr
    );
    let info: Value = serde_json::from_str(&wayfold(&["info", "arm"]).stdout.concat()).unwrap();
    assert_eq!(info["point_count"], 0, "{info}");
}

fn result(ended: &ProcessOutput) -> Value {
    let result: Value = serde_json::from_str(&ended.stdout.concat()).unwrap();
    let total = &result["total"];
    assert!(total["failed"].as_u64() > Some(0), "{result}");
    assert!(
        total["calls"].as_u64() > total["failed"].as_u64(),
        "{result}"
    );
    assert_eq!(result["points"]["after"], Value::Null);
    result
}

#[test]
fn a_load_that_only_reads_tells_its_figures_after_its_server_has_died() {
    let (ended, report) = cut_short("knn=1", "knn");
    assert_eq!(ended.status.code(), Some(0), "{}", ended.stderr);
    result(&ended);
    assert!(!ended.stderr.contains("left"), "{}", ended.stderr);
    assert!(report.contains("lost"), "{report}");
}

#[test]
fn a_load_that_stores_tells_its_figures_and_that_its_points_may_be_left() {
    let (ended, report) = cut_short("insert=1", "insert");
    assert_ne!(ended.status.code(), Some(0));
    let result = result(&ended);
    assert!(result["points"]["inserted"].as_u64() > Some(0), "{result}");
    assert!(
        ended.stderr.contains("may be left in arm"),
        "{}",
        ended.stderr
    );
    assert!(report.contains("lost"), "{report}");
}
