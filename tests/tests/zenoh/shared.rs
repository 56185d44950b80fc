//! A shared index over Zenoh alone keeps its writes and its place despite failures of the server, of the router between
//! them, and of single messages.

#[path = "../e2e/shared/checks.rs"]
mod checks;
#[path = "../e2e/shared/history.rs"]
#[expect(dead_code, reason = "the suite over gRPC inserts with searches too")]
mod history;
mod kills;
mod outage;
#[path = "../e2e/shared/proxy.rs"]
#[expect(dead_code, reason = "the suite over gRPC cuts connections too")]
mod proxy;
mod relay;

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use serde_json::json;
use wayfold::{Error, Index, OpenShared};
use wayfold_index::Space;
use wayfold_tests::States;
use zenoh::Session;

use crate::robot::{Robot, server, server_with, session};
use history::{Content, check_copies, content, wait_for_all};
use relay::{Fate, Relay};

/// The rows of this many points fill three pages.
const THREE_PAGES: usize = 10_000;

/// An index that waits for its server without a limit.
fn open(session: &Session, prefix: &str) -> OpenShared {
    Index::shared_over_zenoh(session.clone(), prefix, "arm").timeout(Duration::from_secs(120))
}

fn shared(robot: &Robot, space: &Space) -> Index {
    let index = open(&robot.session, "wayfold/v1").create(space);
    index.open().unwrap()
}

/// A query of a shared index names its session to the server's log; a bare query does not.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_lines_of_a_call_name_the_session_that_made_it() {
    let (mut server, locator) = server_with(&["--log", "wayfold_server=debug"], &[]);
    let robot = Robot::connect(&locator).await;
    let _index = shared(&robot, &Space::se2());
    robot.json("list", json!({})).await.unwrap();
    let lines = server.log_until("Zenoh/list");
    let peer = format!("peer={}", robot.session.zid());
    let is_end = |it: &&String| it.contains("Zenoh/create") && it.contains("call ended");
    let created = lines.iter().find(is_end).unwrap();
    assert!(created.contains(&peer), "{created}");
    let last = lines.last().unwrap();
    assert!(!last.contains("peer="), "{last}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn copies_are_read_page_by_page_while_others_write() {
    let (_server, locator) = server();
    let space: Space = "R2*SO2".parse().unwrap();
    let robot = Robot::connect(&locator).await;
    let index = shared(&robot, &space);
    let mut states = States::new(space.clone(), 18);
    let rows = states.rows(THREE_PAGES);
    let ids = index.insert_many(rows.chunks(3)).unwrap();
    index.flush().unwrap();
    let stop = AtomicBool::new(false);
    let copies: Vec<Index> = thread::scope(|scope| {
        let index = &index;
        scope.spawn(|| {
            for &id in ids.iter().cycle() {
                if stop.load(Ordering::Relaxed) {
                    break;
                }
                index.remove(id).unwrap();
                index.insert(&states.row()[..]).unwrap();
                index.flush().unwrap();
            }
        });
        let copies = (0..4).map(|_| shared(&robot, &space)).collect();
        stop.store(true, Ordering::Relaxed);
        copies
    });
    let mut copies: Vec<&Index> = copies.iter().collect();
    copies.push(&index);
    wait_for_all(&index, &[0.0; 3], &copies);
    check_copies(&content(&shared(&robot, &space)), &space, &copies);
}

/// The fates take turns by verb.
fn lose(verb: &str, count: u64) -> Fate {
    match (verb, count) {
        // The first page, and the last one, after which the server has released the revision.
        ("scan", 1 | 4) => Fate::Unanswered,
        ("scan", _) => Fate::Answered,
        (_, count) => match count % 5 {
            0 => Fate::Lost,
            1 => Fate::Contradicted,
            2 => Fate::Unanswered,
            3 => Fate::AnsweredTwice,
            _ => Fate::Answered,
        },
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_and_doubled_answers_neither_lose_nor_double_a_write() {
    let (_server, locator) = server();
    let space: Space = "R2".parse().unwrap();
    let robot = Robot::connect(&locator).await;
    let direct = shared(&robot, &space);
    let mut states = States::new(space.clone(), 19);
    let rows = states.rows(THREE_PAGES);
    direct.insert_many(rows.chunks(2)).unwrap();
    direct.flush().unwrap();

    let relay = Relay::open(&robot.session, lose).await;
    let index = open(&robot.session, relay::PREFIX).open().unwrap();
    // Three pages, the first one twice, and all again because the last one was lost.
    assert_eq!(relay.count("scan"), 8);
    let mut expected: Content = content(&direct);
    assert_eq!(content(&index), expected);
    for round in 0..40 {
        let state = [f64::from(round), 0.5];
        let id = index.insert(state).unwrap();
        let point = (0, state.map(f64::to_bits).to_vec());
        assert_eq!(expected.insert(id, point), None);
        let gone = *expected.keys().next().unwrap();
        assert!(index.remove(gone).unwrap());
        expected.remove(&gone);
        index.flush().unwrap();
    }
    assert!(relay.count("write") > 60, "{}", relay.count("write"));
    wait_for_all(&direct, &[1e6, 1e6], &[&index]);
    let stored = content(&shared(&robot, &space));
    expected.retain(|id, point| stored.get(id) == Some(point));
    assert_eq!(expected.len(), stored.len() - 1);
    check_copies(&stored, &space, &[&index, &direct]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_copy_waits_while_the_server_holds_the_revisions_of_others() {
    let settings = [("WAYFOLD_LIMITS__MAX_HELD_SCANS", "1")];
    let (_server, locator) = server_with(&[], &settings);
    let space: Space = "R1".parse().unwrap();
    let robot = Robot::connect(&locator).await;
    let index = shared(&robot, &space);
    let rows = (0..THREE_PAGES).map(|row| [row as f64]);
    index.insert_many(rows).unwrap();
    index.flush().unwrap();
    let scan = json!({ "page_size": 1 });
    let page = robot.json("arm/scan", scan).await.unwrap();
    let last = page["points"]["ids"][0].clone();
    let relay = Relay::open(&robot.session, |_, _| Fate::Answered).await;
    let opening = open(&robot.session, relay::PREFIX);
    let opening = thread::spawn(|| opening.open().unwrap());
    while relay.count("scan") < 3 {
        thread::yield_now();
    }
    let (mut after, held) = (last, &page["held_scan"]);
    loop {
        let next = json!({ "after_id": after, "held_scan": held });
        let page = robot.json("arm/scan", next).await.unwrap();
        if page["held_scan"] == "" {
            break;
        }
        after = page["points"]["ids"]
            .as_array()
            .unwrap()
            .last()
            .unwrap()
            .clone();
    }
    assert_eq!(content(&opening.join().unwrap()), content(&index));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_index_without_a_server_or_a_key_is_not_opened() {
    let alone = session("peer", &[], &[]).await;
    let index = Index::shared_over_zenoh(alone.clone(), "wayfold/v1", "arm");
    let error = index
        .timeout(Duration::from_millis(300))
        .open()
        .unwrap_err();
    assert!(matches!(error, Error::Connection { .. }), "{error}");
    assert_eq!(
        error.to_string(),
        "get_server: no connection to Zenoh, wayfold/v1/server: no server answers"
    );
    for (prefix, name, wrong) in [
        ("wayfold/v1", "*", "name"),
        ("wayfold/**", "arm", "prefix"),
        ("wayfold/v1/", "arm", "prefix"),
        ("wayfold/v1", "", "name"),
    ] {
        let refused = Index::shared_over_zenoh(alone.clone(), prefix, name).open();
        let error = refused.unwrap_err();
        assert!(
            matches!(error, Error::Argument { field, .. } if field == wrong),
            "{error}"
        );
    }
}
