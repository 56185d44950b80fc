//! Several processes with one shared index each, as several shared indices of this process.

use std::{
    sync::{Arc, Barrier},
    thread,
    time::Duration,
};

use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold::{ConnectionStatus, Index, InsertOptions, Search, Space};

use super::{ServerLink, content, shared, wait_for_same};
use crate::index::model::Model;

/// Another process reads after a flush what one wrote, and a third one finds it when it opens.
pub(super) fn another_process_holds_the_same(link: ServerLink) {
    let space = Space::se3();
    let writer = shared(&link, "index", &space);
    let reader = shared(&link, "index", &space);
    let mut model = Model::new(writer.clone(), 7);
    model.run(500);
    wait_for_same(&writer, &reader);
    model.run(500);
    wait_for_same(&writer, &reader);
    assert_eq!(content(&shared(&link, "index", &space)), content(&writer));
    assert_eq!(writer.pending(), 0);
    assert!(matches!(
        reader.status(),
        Some(ConnectionStatus::Following { .. })
    ));
}

/// Writers that change each other's points end with the same points, which are the server's.
pub(super) fn racing_writers_agree(link: ServerLink) {
    const WRITERS: usize = 4;
    let space: Space = "R2".parse().unwrap();
    let indexes: Vec<Index> = (0..WRITERS)
        .map(|_| shared(&link, "index", &space))
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
    let fresh = shared(&link, "index", &space);
    let expected = content(&fresh);
    for index in &indexes {
        while content(index) != expected {
            thread::yield_now();
        }
    }
}

/// The later of any two points of two processes gets the earlier one, by its insert or meanwhile.
pub(super) fn no_edge_between_processes_is_missed(link: ServerLink) {
    const WRITERS: usize = 3;
    const INSERTS: usize = 200;
    let space: Space = "R1".parse().unwrap();
    let indexes: Vec<Index> = (0..WRITERS)
        .map(|_| shared(&link, "index", &space))
        .collect();
    let start = Arc::new(Barrier::new(WRITERS));
    let options = InsertOptions::new().neighbors(Search::within(f64::INFINITY));
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
                        let inserted = index.insert_with(state, options).unwrap();
                        let found = inserted.neighbors.neighbors.iter();
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
    // Each pair comes once: the later point of two gets the earlier one.
    assert_eq!(once, pairs.len());
}
