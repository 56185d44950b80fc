//! The remote form, against a real server in this process.

use std::time::Duration;

use wayfold::{Code, Error, Index, READ_ROWS, ReadRevision, Search, Space};

use super::conformance;
use crate::{
    fake::Fake,
    retrying::last_timeouts,
    server::Server,
    watching::{message, scanned},
};

fn remote(server: &Server, name: &str, space: &Space) -> Index {
    Index::remote(&server.uri, name)
        .create(space)
        .open()
        .unwrap()
}

#[test]
fn equals_brute_force() {
    let server = Server::start();
    let next = std::cell::Cell::new(0);
    let make = |space: &Space| {
        next.set(next.get() + 1);
        remote(&server, &format!("index-{}", next.get()), space)
    };
    conformance::equals_brute_force(make, 300);
}

#[test]
fn refuses_what_is_no_state() {
    let server = Server::start();
    conformance::refuses_what_is_no_state(|space| remote(&server, "index", space));
}

#[test]
fn ends_a_search_that_takes_too_long() {
    let server = Server::start();
    conformance::ends_a_search_that_takes_too_long(|space| remote(&server, "index", space));
}

#[test]
fn answers_tell_what_they_have_read() {
    let server = Server::start();
    conformance::answers_tell_what_they_have_read(|space| remote(&server, "index", space));
}

#[test]
fn misses_no_edge() {
    let server = Server::start();
    conformance::misses_no_edge(|space| remote(&server, "index", space));
}

#[test]
fn declares_its_payloads() {
    let server = Server::start();
    let space: Space = "R1".parse().unwrap();
    conformance::declares_its_payloads(|name, encoding| {
        let index = Index::remote(&server.uri, name);
        match encoding {
            Some(encoding) => index.create(&space).payload_encoding(encoding).open(),
            None => index.open(),
        }
    });
}

#[test]
fn it_is_never_cleared() {
    let server = Server::start();
    let index = remote(&server, "index", &Space::se2());
    let id = index.insert([0.0; 3]).unwrap();
    assert!(matches!(
        index.clear(),
        Err(Error::NotInMemory { call: "clear" })
    ));
    assert!(index.get(id).unwrap().is_some());
    index.remove_all().unwrap();
    assert!(index.is_empty().unwrap());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_feed_that_stands_still_ends_a_call_at_its_timeout() {
    let fake = Fake::start().await;
    fake.watch_tells(vec![Ok(message(5, Vec::new()))]);
    let opening = Index::remote(&fake.uri, "line").timeout(Duration::from_millis(300));
    let index = opening.open().unwrap();
    let refused = index.changes(ReadRevision(3)).unwrap_err();
    assert!(matches!(refused, Error::Timeout { .. }), "{refused:?}");
}

/// A caller that knows all changes of the former index would wait for more of them without end.
#[test]
fn changes_of_an_index_that_was_made_again_are_refused() {
    let server = Server::start();
    let space: Space = "R1".parse().unwrap();
    let index = remote(&server, "index", &space);
    index.insert([1.0]).unwrap();
    let newest = index.search([0.0], &Search::k(1)).unwrap().read_revision;
    let none = index.changes(newest).unwrap().unwrap();
    assert_eq!(
        (none.stored.len(), none.removed.len(), none.read_revision),
        (0, 0, newest)
    );
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let client = server.client().await;
        client.delete_index("index").await.unwrap();
        client.create_index("index", &space).await.unwrap();
    });
    let refused = index.changes(newest).unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition, "{refused}");
    assert_eq!(refused.reason(), Some("UID_MISMATCH"), "{refused}");
}

/// The server ends a scan that waits for the removal of many points.
#[tokio::test(flavor = "multi_thread")]
async fn all_points_are_removed_by_few_calls_after_a_whole_scan() {
    let fake = Fake::start().await;
    let index = Index::remote(&fake.uri, "line").open().unwrap();
    let mut parts = scanned(3, &[(1, 0.0), (2, 10.0)]);
    parts.extend(scanned(3, &[(5, 20.0)]));
    fake.scan_answers(parts.clone(), true);
    index.remove_all().unwrap();
    let requests = fake.remove_requests().into_iter();
    let removed: Vec<Vec<u64>> = requests.map(|request| request.ids).collect();
    assert_eq!(removed, vec![vec![1, 2, 5]]);

    // The scan fails at its last part, whose point has no state.
    parts[1].points.as_mut().unwrap().states = None;
    fake.scan_answers(parts, true);
    let failed = index.remove_all().unwrap_err();
    assert!(matches!(failed, Error::Protocol { .. }), "{failed:?}");
    assert_eq!(fake.remove_requests().len(), 1);
}

/// Each part is sent with the time that those before it have left.
#[tokio::test(flavor = "multi_thread")]
async fn the_parts_of_a_search_have_one_timeout() {
    let fake = Fake::start().await;
    let index = Index::remote(&fake.uri, "line").open().unwrap();
    let search = Search::k(1).timeout(Duration::from_secs(60));
    let states = vec![[0.0]; 3 * READ_ROWS];
    assert_eq!(
        index.search_many(&states, &search).unwrap().len(),
        states.len()
    );
    let mut left: Vec<Duration> = last_timeouts(&fake).take(3).collect();
    left.reverse();
    assert!(
        left.is_sorted_by(|earlier, later| later <= earlier),
        "{left:?}"
    );
}
