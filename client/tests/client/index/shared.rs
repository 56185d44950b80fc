//! The shared form, against a real server in this process.

use std::{
    collections::BTreeMap,
    sync::{Arc, Barrier},
    thread,
    time::Duration,
};

use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold::{Error, Index, InsertOptions, Search, Space, Status};

use super::{conformance, model::Model};
use crate::server::Server;

fn shared(server: &Server, name: &str, space: &Space) -> Index {
    Index::shared(&server.uri, name)
        .create(space)
        .open()
        .unwrap()
}

/// A name for each index of a server.
fn names() -> impl Fn() -> String {
    let next = std::cell::Cell::new(0);
    move || {
        next.set(next.get() + 1);
        format!("index-{}", next.get())
    }
}

/// The points of an index: their tags and states by id.
fn content(index: &Index) -> BTreeMap<u64, (u64, Vec<u64>)> {
    let bits = |state: Vec<f64>| state.into_iter().map(f64::to_bits).collect();
    let points = index.scan().unwrap().map(Result::unwrap);
    points
        .map(|point| (point.id, (point.tag, bits(point.state))))
        .collect()
}

/// Waits until `other` holds what `index` holds, after a flush.
fn wait_for_same(index: &Index, other: &Index) {
    index.flush().unwrap();
    let expected = content(index);
    let mut seen = other
        .changes(Default::default())
        .unwrap()
        .map(|changes| changes.seen);
    while content(other) != expected {
        let now = other.search(vec![0.0; other.space().coordinates()], &Search::k(1));
        seen = now.map(|found| found.seen).ok().max(seen);
        thread::yield_now();
    }
}

#[test]
fn equals_brute_force() {
    let (server, name) = (Server::start(), names());
    conformance::equals_brute_force(|space| shared(&server, &name(), space), 600);
}

#[test]
fn refuses_what_is_no_state() {
    let server = Server::start();
    conformance::refuses_what_is_no_state(|space| shared(&server, "index", space));
}

#[test]
fn ends_a_search_that_takes_too_long() {
    let server = Server::start();
    conformance::ends_a_search_that_takes_too_long(|space| shared(&server, "index", space));
}

#[test]
fn misses_no_edge_of_this_process() {
    let server = Server::start();
    conformance::misses_no_edge(|space| shared(&server, "index", space));
}

/// What one process wrote is what another one reads after a flush, and what a third one finds when it opens.
#[test]
fn another_process_holds_the_same() {
    let server = Server::start();
    let space = Space::se3();
    let writer = shared(&server, "index", &space);
    let reader = shared(&server, "index", &space);
    let mut model = Model::new(writer.clone(), 7);
    model.run(500);
    wait_for_same(&writer, &reader);
    model.run(500);
    wait_for_same(&writer, &reader);
    assert_eq!(content(&shared(&server, "index", &space)), content(&writer));
    assert_eq!(writer.pending(), 0);
    assert!(matches!(reader.status(), Some(Status::Following { .. })));
}

/// Writers that change each other's points end with the same points, which are the server's.
#[test]
fn racing_writers_agree() {
    const WRITERS: usize = 4;
    let server = Server::start();
    let space: Space = "R2".parse().unwrap();
    let indexes: Vec<Index> = (0..WRITERS)
        .map(|_| shared(&server, "index", &space))
        .collect();
    let ids = indexes[0]
        .insert_many((0..20).map(|i| [f64::from(i), 0.0]))
        .unwrap();
    for index in &indexes {
        wait_for_same(&indexes[0], index);
    }
    let start = Arc::new(Barrier::new(WRITERS));
    thread::scope(|scope| {
        for (seed, index) in indexes.iter().enumerate() {
            let (ids, start) = (&ids, Arc::clone(&start));
            scope.spawn(move || {
                let mut rng = ChaCha8Rng::seed_from_u64(seed as u64);
                start.wait();
                for _ in 0..400 {
                    let id = *ids.choose(&mut rng).unwrap();
                    let state = [rng.random_range(0.0..20.0), seed as f64 + 1.0];
                    match rng.random_range(0..5) {
                        0 => drop(index.remove(id).unwrap()),
                        1 | 2 => drop(index.replace(id, state).unwrap()),
                        3 => drop(index.set_tag(id, rng.random_range(0..9)).unwrap()),
                        _ => drop(index.insert(state).unwrap()),
                    }
                }
            });
        }
    });
    indexes.iter().for_each(|index| index.flush().unwrap());
    let fresh = shared(&server, "index", &space);
    let expected = content(&fresh);
    for index in &indexes {
        while content(index) != expected {
            thread::yield_now();
        }
    }
}

/// The later of any two points of two processes gets the earlier one, by its insert or meanwhile.
#[test]
fn no_edge_between_processes_is_missed() {
    const WRITERS: usize = 3;
    const INSERTS: usize = 200;
    let server = Server::start();
    let space: Space = "R1".parse().unwrap();
    let indexes: Vec<Index> = (0..WRITERS)
        .map(|_| shared(&server, "index", &space))
        .collect();
    let start = Arc::new(Barrier::new(WRITERS));
    let ask = InsertOptions::new().ask(Search::within(f64::INFINITY));
    let mut edges: Vec<(u64, u64)> = thread::scope(|scope| {
        let threads: Vec<_> = indexes
            .iter()
            .enumerate()
            .map(|(writer, index)| {
                let start = Arc::clone(&start);
                scope.spawn(move || {
                    start.wait();
                    let mut edges = Vec::new();
                    for at in 0..INSERTS {
                        let state = [(writer * INSERTS + at) as f64];
                        let inserted = index.insert_with(state, ask).unwrap();
                        let found = inserted.found.neighbors.iter();
                        edges.extend(found.map(|neighbor| (inserted.id, neighbor.id)));
                    }
                    index.flush().unwrap();
                    edges
                })
            })
            .collect();
        threads
            .into_iter()
            .flat_map(|thread| thread.join().unwrap())
            .collect()
    });
    let points = WRITERS * INSERTS;
    let mut places = Vec::new();
    for index in &indexes {
        loop {
            let meanwhile = index.wait_meanwhile(Duration::from_secs(60));
            assert!(!meanwhile.has_dropped);
            for answer in meanwhile.answers {
                assert!(!answer.is_superset);
                places.push(answer.points_before);
                let found = answer.neighbors.iter();
                edges.extend(found.map(|neighbor| (answer.id, neighbor.id)));
            }
            if meanwhile.open == 0 {
                break;
            }
        }
    }
    // Each point has a place of its own in the order.
    places.sort_unstable();
    assert!(places.into_iter().eq(0..points));
    let once = edges.len();
    let mut pairs: Vec<_> = edges.iter().map(|&(a, b)| (a.min(b), a.max(b))).collect();
    pairs.sort_unstable();
    pairs.dedup();
    assert_eq!(pairs.len(), points * (points - 1) / 2);
    // Each pair once: the earlier point of two is never told of the later one.
    assert_eq!(once, pairs.len());
}

/// An index that was made again refuses what is pending, which comes back in order.
#[test]
fn writes_to_an_index_that_is_gone_come_back() {
    let server = Server::start();
    let space: Space = "R1".parse().unwrap();
    let index = shared(&server, "index", &space);
    let first = index.insert([1.0]).unwrap();
    index.flush().unwrap();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let client = server.client().await;
        client.delete_index("index").await.unwrap();
        client.create_index("index", &space).await.unwrap();
    });
    // Until the refusal arrives, writes are taken.
    let mut written = Vec::new();
    let refused = loop {
        match index.insert([2.0]) {
            Ok(id) => written.push(id),
            Err(error) => break error,
        }
    };
    assert!(matches!(refused, Error::WritesRefused { .. }), "{refused}");
    assert!(matches!(index.flush(), Err(Error::WritesRefused { .. })));
    let unsent: Vec<u64> = index
        .take_unsent()
        .into_iter()
        .map(|write| match write {
            wayfold::UnsentWrite::Put { id, .. } => id,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(unsent, written);
    while index.get(first).unwrap().is_some() {
        thread::yield_now();
    }
    assert_eq!(index.len().unwrap(), 0);
    let id = index.insert([3.0]).unwrap();
    index.flush().unwrap();
    let fresh = shared(&server, "index", &space);
    assert_eq!(content(&fresh), content(&index));
    assert!(fresh.get(id).unwrap().is_some());
}

#[test]
fn an_index_of_another_space_is_refused() {
    let server = Server::start();
    drop(shared(&server, "index", &Space::se2()));
    let other = Index::shared(&server.uri, "index")
        .create(&Space::se3())
        .open();
    assert_eq!(other.unwrap_err().code(), wayfold::Code::AlreadyExists);
    let missing = Index::shared(&server.uri, "missing").open().unwrap_err();
    assert_eq!(missing.code(), wayfold::Code::NotFound);
}

/// Its calls block, and its drop does not, in a task of another runtime.
#[test]
fn it_may_be_used_and_dropped_in_a_task() {
    let server = Server::start();
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let index = shared(&server, "index", &Space::se2());
        let id = index
            .insert_with([0.0; 3], InsertOptions::new().payload(b"start"))
            .unwrap()
            .id;
        index.flush().unwrap();
        assert_eq!(index.payload(id).unwrap(), Some(b"start".to_vec()));
    });
}

#[test]
fn a_closed_index_takes_no_writes_and_gives_none_back() {
    let server = Server::start();
    let index = shared(&server, "index", &Space::se2());
    index.insert([0.0; 3]).unwrap();
    assert_eq!(index.close(std::time::Duration::from_secs(20)), []);
    assert!(matches!(index.insert([1.0; 3]), Err(Error::Closed)));
    assert_eq!(index.len().unwrap(), 1);
    assert!(matches!(index.status(), Some(Status::Closed)));
    assert!(matches!(index.clear(), Err(Error::NotInMemory { .. })));
}
