//! Checks of shared indices, whatever carries their calls.

use std::{collections::BTreeSet, thread, time::Duration};

use wayfold::{Client, Code, ConnectionStatus, Error, Index, OpenShared, WatchEvent};
use wayfold_tests::{ServerProcess, Signal, States, bits};

use super::history::{Content, History, check_copies, content, wait_for_all};

pub(super) const MAX_PENDING_BYTES: usize = 100_000;
/// An insert into the plane holds an id, a tag and two coordinates at least.
const MIN_STEP_BYTES: usize = 32;

/// Waits until an index has another status.
pub(super) fn wait_for_status(index: &Index, is_it: impl Fn(&ConnectionStatus) -> bool) {
    while !index.status().as_ref().is_some_and(&is_it) {
        thread::yield_now();
    }
}

/// Asserts that the copies, and a new one from `open`, hold the points of all calls, and that no id was given twice.
pub(super) fn check_all(
    copies: &[&Index],
    open: impl FnOnce() -> Index,
    common: &[u64],
    histories: &[History],
) {
    let space = copies[0].space();
    wait_for_all(copies[0], &States::new(space.clone(), 99).row(), copies);
    let stored = content(&open());
    check_copies(&stored, space, copies);
    let expected: Content = histories.iter().flat_map(History::points).collect();
    let is_stored = |(id, point): (&u64, _)| stored.get(id) == Some(point);
    assert!(expected.iter().all(is_stored));
    // The last point, which the copies waited for, is no writer's.
    let others = |id: &&u64| !expected.contains_key(id) && !common.contains(id);
    assert_eq!(stored.keys().filter(others).count(), 1);
    let given: Vec<u64> = histories.iter().flat_map(|h| h.assigned.clone()).collect();
    let distinct: BTreeSet<u64> = given.iter().copied().collect();
    assert_eq!(given.len(), distinct.len(), "an id was given twice");
    println!("{} points given, {} stored", given.len(), stored.len());
}

/// Asserts that each of these contents of one copy without pending writes, in their order, is that of some revision, which
/// never goes backwards.
pub(super) async fn check_revisions(uri: &str, contents: &[Content]) {
    let client = Client::connect(uri).await.unwrap();
    let index = client.index("arm").await.unwrap();
    let newest = index.revision().number;
    let mut watch = index.watch().after(index.revision_at(0)).await.unwrap();
    let mut contents = contents.iter().enumerate().peekable();
    let (mut points, mut revision) = (Content::new(), 0);
    loop {
        while contents.next_if(|(_, shown)| **shown == points).is_some() {}
        let Some((number, _)) = contents.peek() else {
            return;
        };
        assert!(revision < newest, "content {number} is of no revision");
        let event = watch.next().await.unwrap();
        let Some(WatchEvent::Mutation(mutation)) = event else {
            panic!("{event:?}");
        };
        revision = mutation.revision.number;
        for id in &mutation.removed_ids {
            points.remove(id);
        }
        for point in mutation.stored.iter() {
            points.insert(point.id, (point.tag, bits(point.state)));
        }
    }
}

/// Asserts that the pending writes of an index in the plane are bounded while its server is silent, and that the server
/// stores them after that. `open` creates the index and opens further copies.
pub(super) fn check_silence(
    server: &ServerProcess,
    index: OpenShared,
    timeout: Duration,
    open: impl Fn() -> Index,
) {
    let other = open();
    let index = index.timeout(timeout).max_pending_bytes(MAX_PENDING_BYTES);
    let index = index.open().unwrap();
    let first = index.insert([-1.0, 0.0]).unwrap();
    index.flush().unwrap();

    server.process().signal(Signal::Pause);
    let mut inserted = Vec::new();
    let error = loop {
        match index.insert([inserted.len() as f64, 0.0]) {
            Ok(id) => inserted.push(id),
            Err(error) => break error,
        }
    };
    assert!(matches!(error, Error::Timeout { .. }), "{error}");
    assert_eq!(index.pending(), inserted.len() as u64);
    assert!(inserted.len() * MIN_STEP_BYTES <= MAX_PENDING_BYTES);
    // Nothing else waits, nor does the removal of a point that is not there.
    assert!(!index.remove(u64::MAX >> 1).unwrap());
    assert_eq!(index.len().unwrap(), inserted.len() + 1);
    let last = inserted.len() - 1;
    let nearest = index.nearest([last as f64, 0.1]).unwrap().unwrap();
    assert_eq!(nearest.id, inserted[last]);
    for refused in [index.remove(first).map(drop), index.flush()] {
        assert!(matches!(refused, Err(Error::Timeout { .. })), "{refused:?}");
    }
    assert_eq!(index.pending(), inserted.len() as u64);
    wait_for_status(&index, |status| match status {
        ConnectionStatus::Disconnected { why, .. } => why.code() == Code::DeadlineExceeded,
        _ => false,
    });

    server.process().signal(Signal::Resume);
    while index.pending() > 0 {
        thread::yield_now();
    }
    index.flush().unwrap();
    wait_for_all(&other, &[0.0, 2.0], &[&index, &other]);
    assert_eq!(index.len().unwrap(), inserted.len() + 2);
    check_copies(&content(&open()), other.space(), &[&index, &other]);
    wait_for_status(&index, |status| {
        matches!(status, ConnectionStatus::Following { .. })
    });
    assert_eq!(index.close(timeout), []);
}
