//! The server's report of a failed disk to an operator.

use wayfold_tests::{Process, ProcessOutput, Signal, Stubs, insert_request};

use super::{RECOVERED, check_refusals, disk::Disk};

/// Refused writes.
const WRITES: u64 = 50;
/// The server has several indices, and each could log the failure.
const INDEXES: u64 = 5;

fn insert(uri: &str, row: &str) -> ProcessOutput {
    let command = env!("CARGO_BIN_EXE_cli-process");
    let mut process = Process::start(command, &["--server", uri, "insert", "arm-0", "-"]);
    process.say(row);
    process.finish()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn one_line_says_that_it_began_and_one_that_it_ended() {
    let disk = Disk::new();
    let mut server = disk.serve();
    let mut stubs = Stubs::connect(server.uri()).await;
    for index in 0..INDEXES {
        stubs.create(&format!("arm-{index}"), "R2").await;
    }
    disk.fail("full 28");
    for write in 0..WRITES {
        let request = insert_request(&format!("arm-{}", write % INDEXES), &[1.0, 2.0], 2);
        check_refusals(&[stubs.points.insert(request).await.unwrap_err()]);
    }
    let finished = insert(server.uri(), "1,2");
    assert!(!finished.status.success(), "{finished:?}");
    assert_eq!(finished.stderr.lines().count(), 1, "{finished:?}");
    for part in ["No space left on device", "tries repeatedly"] {
        assert!(finished.stderr.contains(part), "{finished:?}");
    }
    disk.mend();
    server.log_until(RECOVERED);
    let finished = insert(server.uri(), "1,2");
    assert!(finished.status.success(), "{finished:?}");
    let log = server.stop(Signal::Terminate).stderr;
    let count = |part| log.lines().filter(|line| line.contains(part)).count();
    assert_eq!(count("ERROR"), 1, "{log}");
    assert_eq!(count("the log has failed"), 1, "{log}");
    assert_eq!(count(RECOVERED), 1, "{log}");
    // However often the store tried to reopen, at most one warning reports that it could not.
    assert!(count("WARN") <= 1, "{log}");
}
