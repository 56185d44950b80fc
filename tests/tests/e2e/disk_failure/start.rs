//! A server is started while the disk fails.

use tonic::Code;
use wayfold_tests::{Process, ProcessOutput, Refusal, ServerProcess, Signal, Stubs};

use super::{LOAD, RECOVERED, SEED, disk::Disk};
use crate::clients::{Clients, FaultTime};

/// The server ended with a message and without a panic.
fn check_refused(finished: &ProcessOutput) {
    assert_eq!(finished.status.code(), Some(1), "{finished:?}");
    assert_eq!(finished.stderr.lines().count(), 1, "{finished:?}");
    let advice = "see that this user may write there and that the disk has room";
    assert!(finished.stderr.contains(advice), "{finished:?}");
}

#[test]
fn no_data_directory_is_begun_on_a_disk_that_fails() {
    for how in ["full 28", "torn 28", "readonly 30", "full 5", "syncs 5"] {
        let disk = Disk::new();
        disk.fail(how);
        check_refused(&disk.start().finish());
        disk.mend();
        disk.serve().stop(Signal::Terminate);
    }
}

/// The server, or the output of a process that did not start.
fn up(mut process: Process) -> Result<ServerProcess, ProcessOutput> {
    match process.line() {
        Some(line) => Ok(ServerProcess::listening(process, &line)),
        None => Err(process.finish()),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_finds_its_disk_failing_says_so_and_recovers_by_itself() {
    let disk = Disk::new();
    let server = disk.serve();
    let mut clients = Clients::new(&server, SEED, LOAD).await;
    clients.work(server, FaultTime::Acknowledged(100)).await;
    for (how, is_up) in [
        ("full 28", true),
        ("torn 28", true),
        ("full 5", true),
        ("syncs 5", true),
        ("readonly 30", false),
    ] {
        disk.fail(how);
        let server = match up(disk.start()) {
            Ok(mut server) => {
                assert!(is_up, "{how}");
                let mut stubs = Stubs::connect(server.uri()).await;
                let index = "arm".to_owned();
                let request = wayfold_proto::v1::GetIndexRequest { index_name: index };
                let status = stubs.indexes.get_index(request).await.unwrap_err();
                let refusal = Refusal::of(&status);
                assert_eq!(
                    (refusal.code, &*refusal.reason),
                    (Code::Unavailable, "STORAGE_FAILED"),
                    "{how}: {status:?}"
                );
                assert!(refusal.message.contains("tries repeatedly"), "{status:?}");
                disk.mend();
                server.log_until(RECOVERED);
                server
            }
            Err(finished) => {
                assert!(!is_up, "{how}");
                check_refused(&finished);
                disk.mend();
                disk.serve()
            }
        };
        clients.check(&server).await;
        clients.work(server, FaultTime::Acknowledged(20)).await;
    }
    clients.check(&disk.serve()).await;
}
