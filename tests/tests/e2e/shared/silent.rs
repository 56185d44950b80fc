//! A server that does not answer: writes go on until the pending ones fill their bound, and then fail.

use std::{net::TcpListener, time::Duration};

use wayfold::{Error, Index, InsertOptions, Neighbor, Search};
use wayfold_index::Space;
use wayfold_tests::{Process, ServerProcess, Signal};

use super::{
    checks::{MAX_PENDING_BYTES, check_silence},
    command,
    history::{check_copies, content, wait_for_all},
    shared,
};

const TIMEOUT: Duration = Duration::from_secs(3);

#[test]
fn pending_writes_are_bounded_while_the_server_is_silent() {
    let directory = tempfile::tempdir().unwrap();
    let mut command = command(&directory.path().join("data"), "127.0.0.1:0");
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let index = Index::shared(server.uri(), "arm");
    let open = || shared(server.uri(), &"R2".parse().unwrap());
    check_silence(&server, index, TIMEOUT, open);
}

/// What the inserts found is held until the server has stored their points.
#[test]
fn searches_of_pending_inserts_are_bounded_while_the_server_is_silent() {
    const K: u32 = 1_000;
    let directory = tempfile::tempdir().unwrap();
    let mut command = command(&directory.path().join("data"), "127.0.0.1:0");
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let index = Index::shared(server.uri(), "arm")
        .create(&"R2".parse().unwrap())
        .timeout(TIMEOUT)
        .max_pending_bytes(MAX_PENDING_BYTES);
    let index = index.open().unwrap();
    index
        .insert_many((0..K).map(|x| [f64::from(x), 0.0]))
        .unwrap();
    index.flush().unwrap();

    server.process().signal(Signal::Pause);
    let mut inserted = 0;
    let error = loop {
        let options = InsertOptions::new().id(1 << 40 | inserted as u64);
        match index.insert_with([0.0, 1.0], options.neighbors(Search::k(K))) {
            Ok(_) => inserted += 1,
            Err(error) => break error,
        }
    };
    assert!(matches!(error, Error::Timeout { .. }), "{error}");
    // The last search may exceed the bound.
    let found_bytes = (inserted - 1) * K as usize * size_of::<Neighbor>();
    assert!(
        inserted > 0 && found_bytes <= MAX_PENDING_BYTES,
        "{inserted}"
    );

    server.process().signal(Signal::Resume);
    assert_eq!(index.close(TIMEOUT), []);
    assert_eq!(index.len().unwrap(), K as usize + inserted);
}

/// A write that was given back may have reached the server, as this one has.
#[test]
fn a_closed_copy_holds_what_the_server_took() {
    let directory = tempfile::tempdir().unwrap();
    let mut command = command(&directory.path().join("data"), "127.0.0.1:0");
    let server = ServerProcess::ready(Process::spawn(&mut command));
    let space: Space = "R2".parse().unwrap();
    let (index, other) = (shared(server.uri(), &space), shared(server.uri(), &space));
    server.process().signal(Signal::Pause);
    let given_back = index.insert([1.0, 1.0]).unwrap();
    assert_eq!(index.close(TIMEOUT).len(), 1);
    assert_eq!(index.len().unwrap(), 0);
    server.process().signal(Signal::Resume);
    // It lies in the server's socket, and may be taken after other writes.
    while other.get(given_back).unwrap().is_none() {
        std::thread::yield_now();
    }
    wait_for_all(&other, &[2.0, 2.0], &[&index]);
    check_copies(&content(&other), &space, &[&index]);
}

#[test]
fn an_index_is_not_opened_at_an_address_that_does_not_answer() {
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let uri = format!("http://{}", silent.local_addr().unwrap());
    let opened = Index::shared(&uri, "arm")
        .timeout(Duration::from_millis(300))
        .open();
    let error = opened.unwrap_err();
    assert!(matches!(error, Error::Timeout { .. }), "{error}");
}
