//! The verb `load`: its reports, its scenarios, and its end by a signal.

use std::{fs, net::TcpListener, process::Stdio};

use serde_json::{Value, json};

use super::{number, point_count};
use crate::{
    process::{command, send},
    server::Server,
};

#[test]
fn a_report_is_one_page_without_anything_from_elsewhere() {
    let server = Server::start();
    server.run(&["create", "arm", "--space", "R3*SO3:0.15"]);
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("arm.html");
    let path = file.to_str().unwrap();
    for _ in 0..2 {
        let run = server.run(&["load", "arm", "--calls", "300", "--report", path]);
        assert!(run.stdout.contains("the report is in"), "{}", run.stdout);
    }
    assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    let page = fs::read_to_string(&file).unwrap();
    // The address of the server is text, not a resource.
    let page = page.replace(&server.uri, "SERVER");
    for wrong in [
        "http://", "https://", "<script", "<link", "<img", "url(", "@import", "src=",
    ] {
        assert!(!page.contains(wrong), "the page has {wrong}");
    }
    assert_eq!(page.matches("<svg ").count(), 3);
    for part in [
        "prefers-color-scheme: dark",
        "SERVER",
        "R3*SO3:0.15",
        "insert=1,knn=8,query=1,get=1",
    ] {
        assert!(page.contains(part), "the page has no {part}");
    }
}

#[test]
fn a_report_that_cannot_be_written_stops_the_run_before_it_begins() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    let directory = tempfile::tempdir().unwrap();
    let directory = directory.path().to_str().unwrap();
    for path in ["/no/such/directory/report.html", directory] {
        let run = server.run(&["load", "line", "--calls", "5", "--keep", "--report", path]);
        let error = run.error(3);
        assert!(
            error.contains(path) && error.contains("nothing was sent"),
            "{error}"
        );
    }
    assert_eq!(point_count(&server, "line"), 0);
}

#[test]
fn a_scenario_has_phases() {
    let server = Server::start();
    server.run(&["create", "arm", "--space", "R2*SO2"]);
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("two.toml");
    let path = file.to_str().unwrap();
    let text = "seed = 4\nworkers = 2\n[[phase]]\nname = \"fill\"\nmix = \"insert=1\"\nbatch = 10\ncalls = 20\n\
                [[phase]]\nname = \"search\"\nmix = \"knn=1\"\nrate = 1000\ncalls = 50\n";
    fs::write(&file, text).unwrap();
    let args = [
        "load",
        "arm",
        "--scenario",
        path,
        "--keep",
        "--fill",
        "0",
        "--json",
    ];
    let result = server.run(&args).line();
    let phases = result["phases"].as_array().unwrap();
    let named: Vec<_> = phases
        .iter()
        .map(|phase| [&phase["name"], &phase["loop"]])
        .collect();
    assert_eq!(named, [["fill", "closed"], ["search", "open"]]);
    assert_eq!(
        (&phases[0]["calls"], &phases[1]["calls"]),
        (&json!(20), &json!(50))
    );
    assert_eq!(phases[1]["due"], 50);
    assert_eq!(
        (&result["seed"], &phases[1]["workers"]),
        (&json!(4), &json!(2))
    );
    assert_eq!(point_count(&server, "arm"), 200);
    // The steps hold every call, each in its phase.
    let steps = result["steps"].as_array().unwrap();
    let answered = |phase: u64, verb: &str| -> u64 {
        let of_phase = steps.iter().filter(|step| step["phase"] == phase);
        of_phase
            .filter_map(|step| step["answered"][verb].as_u64())
            .sum()
    };
    assert_eq!((answered(0, "insert"), answered(1, "knn")), (20, 50));
    // Options go before the file.
    let result = server.run(&[&args[..], &["--calls", "3"]].concat()).line();
    assert_eq!(result["total"]["calls"], 6);

    fs::write(&file, "[[phase]]\nraet = 5\n").unwrap();
    let run = server.run(&args);
    let error = run.json_error(3);
    assert_eq!(error["reason"], "SCENARIO");
    assert!(
        error["message"]
            .as_str()
            .unwrap()
            .contains("a similar argument exists: '--rate'"),
        "{error}"
    );
}

#[test]
fn the_scenarios_of_the_repository_are_read() {
    let server = Server::start();
    server.run(&["create", "arm", "--space", "R2*SO2"]);
    let directory = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios");
    let mut read = 0;
    for file in fs::read_dir(directory).unwrap() {
        let path = file.unwrap().path();
        let path = path.to_str().unwrap();
        let args = [
            "load",
            "arm",
            "--calls",
            "5",
            "--batch",
            "10",
            "--warmup",
            "10ms",
            "--scenario",
            path,
            "--json",
        ];
        let result = server.run(&args).line();
        let phases = result["phases"].as_array().unwrap().len();
        assert_eq!(result["total"]["calls"], 5 * phases, "{path}");
        read += 1;
    }
    assert_eq!(read, 8);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_signal_ends_the_run_and_the_result_and_the_report_are_written() {
    let server = Server::start();
    let index = server.index("line", "R1").await;
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("line.html");
    for signal in ["INT", "TERM"] {
        let report = ["--report", file.to_str().unwrap()];
        let args = [
            "load",
            "line",
            "--duration",
            "1h",
            "--mix",
            "insert=1",
            "--json",
        ];
        let child = command(&server.uri, &[&args[..], &report].concat())
            .stdin(Stdio::null())
            .spawn()
            .unwrap();
        while index.info().await.unwrap().point_count == 0 {
            tokio::task::yield_now().await;
        }
        send(signal, &child);
        let ended = tokio::task::spawn_blocking(move || child.wait_with_output());
        let output = ended.await.unwrap().unwrap();
        assert_eq!(output.status.code(), Some(3), "SIG{signal}");
        assert!(String::from_utf8_lossy(&output.stderr).contains("INTERRUPTED"));
        let result: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(result["interrupted"], true);
        assert!(number(&result["total"]["answered"]) > 0);
        assert_eq!(result["points"]["after"], 0);
        assert_eq!(index.info().await.unwrap().point_count, 0);
        assert!(
            fs::read_to_string(&file)
                .unwrap()
                .contains("A signal ended the run early")
        );
        fs::remove_file(&file).unwrap();
    }
}

#[test]
fn a_signal_ends_a_run_whose_server_does_not_answer() {
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let uri = format!("http://{}", silent.local_addr().unwrap());
    let child = command(&uri, &["load", "line"]).spawn().unwrap();
    let connection = silent.accept().unwrap();
    send("INT", &child);
    let output = child.wait_with_output().unwrap();
    drop(connection);
    // The call itself would end at its deadline, with another error.
    assert_eq!(output.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&output.stderr).contains("interrupted"));
}
