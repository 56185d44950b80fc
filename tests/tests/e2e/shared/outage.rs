//! A copy that missed more than the server keeps reads all points again, with its pending writes on top.

use std::{collections::BTreeSet, process::Command};

use wayfold::{
    Client, ConnectionStatus, Error, Index, InsertOptions, ResetReason, Search, WatchEvent,
};
use wayfold_index::Space;
use wayfold_tests::{Process, ServerProcess, Signal, States, server};

use super::{
    checks::wait_for_status,
    command,
    history::{check_copies, content, take_answers, wait_for_all},
    proxy::Proxy,
    shared,
};

/// Its rows are so long that the outage exceeds the buffers of the network with few points.
const SPACE: &str = "R64";

/// A state of the space, by its first two coordinates.
fn at(x: f64, y: f64) -> [f64; 64] {
    let mut state = [0.0; 64];
    (state[0], state[1]) = (x, y);
    state
}

/// A server that keeps next to no mutations.
fn start(command: &mut Command) -> ServerProcess {
    let command = command.env("WAYFOLD_INDEX__WINDOW_BYTES", "1000");
    ServerProcess::ready(Process::spawn(command))
}

/// A copy whose server is away, one that stays connected, and a handle that asks the server itself.
struct Outage {
    server: ServerProcess,
    way: Proxy,
    away: Index,
    there: Index,
    client: Client,
    space: Space,
    _directory: tempfile::TempDir,
}

impl Outage {
    async fn new() -> Outage {
        let directory = tempfile::tempdir().unwrap();
        let server = start(&mut command(&directory.path().join("data"), "127.0.0.1:0"));
        let space: Space = SPACE.parse().unwrap();
        let way = Proxy::to(server.uri()).await;
        Outage {
            there: shared(server.uri(), &space),
            away: shared(&way.uri, &space),
            client: Client::connect(server.uri()).await.unwrap(),
            way,
            server,
            space,
            _directory: directory,
        }
    }

    /// Cuts the copy off, and returns the newest revision that it may have.
    async fn begin(&self, held: bool) -> wayfold::Revision {
        wait_for_all(&self.there, &at(1e6, 1e6), &[&self.away]);
        let index = self.client.index("arm").await.unwrap();
        let reached = index.info().await.unwrap().revision;
        match held {
            true => self.way.hold(self.server.uri()),
            false => self.way.close(),
        }
        reached
    }

    /// Writes more than the server keeps, and more than the buffers of the network hold.
    async fn pass_window(&self, reached: wayfold::Revision, seed: u64) {
        let mut states = States::new(self.space.clone(), seed);
        for _ in 0..40 {
            let rows = states.rows(500);
            self.there.insert_many(rows.chunks(64)).unwrap();
            self.there.flush().unwrap();
        }
        let index = self.client.index("arm").await.unwrap();
        let mut watch = index.watch().after(reached).await.unwrap();
        let Ok(Some(WatchEvent::Reset(reset))) = watch.next().await else {
            panic!("the window is wider than thought")
        };
        assert_eq!(reset.reason, ResetReason::WindowPassed);
    }

    /// Ends the outage, and asserts that the copy reads all points again and that both hold what a new one does.
    fn end(&self) {
        let before = self
            .away
            .search(at(0.0, 0.0), &Search::k(1))
            .unwrap()
            .read_revision;
        assert!(self.away.changes(before).unwrap().is_some());
        self.way.lead_to(self.server.uri());
        self.away.flush().unwrap();
        self.compare();
        assert_eq!(self.away.changes(before).unwrap(), None);
    }

    fn compare(&self) {
        let copies = [&self.there, &self.away];
        wait_for_all(&self.there, &at(1e6, 1e6), &copies);
        let fresh = shared(self.server.uri(), &self.space);
        check_copies(&content(&fresh), &self.space, &copies);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pending_writes_survive_a_reload() {
    let outage = Outage::new().await;
    let (away, there) = (&outage.away, &outage.there);
    for (seed, held) in [(1, false), (2, true)] {
        let common = there.insert(at(100.0, 100.0)).unwrap();
        let removed = there.insert(at(101.0, 100.0)).unwrap();
        there.flush().unwrap();
        let reached = outage.begin(held).await;
        let mine = away.insert(at(200.0, 200.0)).unwrap();
        let gone = away.insert(at(201.0, 200.0)).unwrap();
        assert!(away.remove(gone).unwrap());
        assert!(away.replace(common, at(102.0, 100.0)).unwrap());
        assert!(away.set_tag(removed, 9).unwrap());
        assert!(away.remove(removed).unwrap());
        assert!(there.set_tag(common, 7).unwrap());
        there.flush().unwrap();
        outage.pass_window(reached, seed).await;
        assert!(away.get(common).unwrap().unwrap().tag == 0, "not reached");
        outage.end();
        let (point, state) = (
            away.get(common).unwrap().unwrap(),
            at(102.0, 100.0).to_vec(),
        );
        assert_eq!((point.tag, point.state), (7, state));
        // Later writes of others count for points that were pending when the copy was read again.
        assert!(there.remove(mine).unwrap());
        assert!(there.set_tag(common, 8).unwrap());
        outage.compare();
        assert_eq!(away.get(mine).unwrap(), None);
    }
}

/// The neighbours that came before a pending point during the outage are told, in a superset.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_edge_is_missed_over_a_reload() {
    let outage = Outage::new().await;
    let (away, there) = (&outage.away, &outage.there);
    let before = there.insert(at(103.0, 100.0)).unwrap();
    let reached = outage.begin(false).await;
    let mut inserts = Vec::new();
    for search in [Search::within(5.0), Search::k(1), Search::k(3).radius(4.0)] {
        let options = InsertOptions::new().neighbors(search);
        // Each is alone with its neighbours.
        let x = 100.0 + 100.0 * inserts.len() as f64;
        let inserted = away.insert_with(at(x, 100.0), options).unwrap();
        let near = there.insert(at(x, 101.0)).unwrap();
        inserts.push((inserted, near));
    }
    assert_eq!(inserts[0].0.neighbors.neighbors[0].id, before);
    there.flush().unwrap();
    outage.pass_window(reached, 3).await;
    outage.end();
    let answers = take_answers(away);
    assert!(answers.iter().all(|answer| answer.is_superset));
    for (inserted, near) in inserts {
        let of_it = answers.iter().filter(|answer| answer.id == inserted.id);
        let ids: BTreeSet<u64> = of_it
            .flat_map(|answer| answer.neighbors.iter().map(|neighbor| neighbor.id))
            .collect();
        assert!(ids.contains(&near), "{inserted:?}: {ids:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_index_that_is_gone_or_has_another_space_ends() {
    let server = server!();
    let way = Proxy::to(server.uri()).await;
    let direct = Client::connect(server.uri()).await.unwrap();
    let index = shared(&way.uri, &"R1".parse().unwrap());
    let id = index.insert([0.0]).unwrap();
    index.flush().unwrap();

    // Another client recreates the index with another space.
    way.close();
    direct.delete_index("arm").await.unwrap();
    let wide = SPACE.parse().unwrap();
    direct.create_index("arm", &wide).await.unwrap();
    assert_eq!(index.nearest([0.9]).unwrap().unwrap().id, id, "what it had");
    index.insert([1.0]).unwrap();
    way.lead_to(server.uri());
    wait_for_status(&index, |status| {
        matches!(status, ConnectionStatus::Ended { .. })
    });
    let error = index.nearest([0.9]).unwrap_err();
    let Error::Ended { why } = &error else {
        panic!("{error}")
    };
    assert!(matches!(**why, Error::OtherSpace { .. }), "{why}");
    assert!(index.insert([2.0]).is_err());
    assert_eq!(index.take_unsent().len(), 1);

    let index = shared(&way.uri, &wide);
    direct.delete_index("arm").await.unwrap();
    wait_for_status(&index, |status| {
        matches!(status, ConnectionStatus::Ended { .. })
    });
    let error = index.nearest(at(0.9, 0.0)).unwrap_err();
    assert_eq!(error.reason(), Some("INDEX_NOT_FOUND"), "{error}");
}

/// A server in memory is killed, and its successor has an empty index of the same name.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pending_writes_come_back_from_a_server_that_lost_the_index() {
    let server = server!();
    let way = Proxy::to(server.uri()).await;
    let space: Space = SPACE.parse().unwrap();
    let index = shared(&way.uri, &space);
    index.insert(at(0.0, 0.0)).unwrap();
    index.flush().unwrap();
    way.close();
    server.stop(Signal::Kill);
    let pending = index.insert(at(1.0, 0.0)).unwrap();
    let server = server!();
    drop(shared(server.uri(), &space));
    way.lead_to(server.uri());
    assert!(matches!(index.flush(), Err(Error::WritesRefused { .. })));
    let unsent = index.take_unsent();
    let ids = unsent.iter().map(|write| match write {
        wayfold::UnsentWrite::Put { id, .. } => *id,
        other => panic!("{other:?}"),
    });
    assert_eq!(ids.collect::<Vec<_>>(), [pending]);
    let new = index.insert(at(2.0, 0.0)).unwrap();
    index.flush().unwrap();
    let fresh = shared(server.uri(), &space);
    wait_for_all(&fresh, &at(3.0, 0.0), &[&index]);
    check_copies(&content(&fresh), &space, &[&index]);
    assert_eq!(index.nearest(at(2.0, 0.0)).unwrap().unwrap().id, new);
}

/// A point that arrives new and is tagged before the copy hears of either counts as new.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_edge_to_a_point_that_was_tagged_meanwhile_is_missed() {
    let server = server!();
    let way = Proxy::to(server.uri()).await;
    let space: Space = "R1".parse().unwrap();
    let (there, away) = (shared(server.uri(), &space), shared(&way.uri, &space));
    way.close();
    let ask = InsertOptions::new().neighbors(Search::within(2.0));
    let inserted = away.insert_with([0.0], ask).unwrap();
    let near = there.insert([1.0]).unwrap();
    there.flush().unwrap();
    assert!(there.set_tag(near, 5).unwrap());
    there.flush().unwrap();
    way.lead_to(server.uri());
    away.flush().unwrap();
    let answers = take_answers(&away);
    let ids = answers
        .iter()
        .map(|answer| (answer.id, answer.neighbors[0].id));
    assert_eq!(ids.collect::<Vec<_>>(), [(inserted.id, near)]);
}
