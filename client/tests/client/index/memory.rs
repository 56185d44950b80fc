//! The form in memory.

use wayfold::{Index, InsertOptions, PayloadEncoding, Search, Space};

use super::{conformance, model::Model};

fn in_memory(space: &Space) -> Index {
    Index::in_memory(space).unwrap()
}

#[test]
fn equals_brute_force() {
    conformance::equals_brute_force(in_memory, 1_500);
}

#[test]
fn equals_brute_force_where_inserts_merge() {
    conformance::equals_brute_force(|space| Index::in_memory_inline(space).unwrap(), 1_500);
}

#[test]
fn refuses_what_is_no_state() {
    conformance::refuses_what_is_no_state(in_memory);
}

#[test]
fn ends_a_search_that_takes_too_long() {
    conformance::ends_a_search_that_takes_too_long(in_memory);
}

#[test]
fn answers_tell_what_they_have_read() {
    conformance::answers_tell_what_they_have_read(in_memory);
}

#[test]
fn misses_no_edge() {
    conformance::misses_no_edge(in_memory);
}

/// It has no other readers to whom it could declare an encoding.
#[test]
fn declares_nothing_about_its_payloads() {
    let index = in_memory(&Space::se2());
    assert_eq!(index.payload_encoding(), PayloadEncoding::Unspecified);
}

#[test]
fn a_cleared_index_is_empty_and_gives_no_id_twice() {
    let index = in_memory(&Space::se2());
    let first = index.insert([0.0; 3]).unwrap();
    let before = index.search([0.0; 3], &Search::k(1)).unwrap();
    index.clear().unwrap();
    assert!(index.is_empty().unwrap());
    assert_eq!(index.nearest([0.0; 3]).unwrap(), None);
    assert_eq!(index.changes(before.read_revision).unwrap(), None);
    let second = index.insert([1.0; 3]).unwrap();
    assert!(second > first);
    let new = index
        .search([0.0; 3], &Search::k(1).since(before.read_revision))
        .unwrap();
    assert_eq!(new.neighbors[0].id, second);
}

#[test]
fn the_last_id_is_given_and_none_after_it() {
    let index = in_memory(&"R1".parse().unwrap());
    let last = (1 << 63) - 1;
    index
        .insert_with([0.0], InsertOptions::new().id(last))
        .unwrap();
    assert!(index.insert([1.0]).is_err());
    assert!(index.insert_many([[1.0]]).is_err());
    assert_eq!(index.len().unwrap(), 1);
}

/// Searches on other threads see whole changes while one writes and the merging thread merges.
#[test]
fn searches_beside_a_writer_are_whole() {
    let index = in_memory(&"R2".parse().unwrap());
    std::thread::scope(|scope| {
        let writer = scope.spawn(|| {
            for batch in 0..400 {
                let states = (0..100).map(|row| [f64::from(batch), f64::from(row)]);
                index.insert_many(states).unwrap();
            }
        });
        while !writer.is_finished() {
            let found = index.nearest_r([0.0; 2], 1e6).unwrap();
            assert_eq!(found.len() % 100, 0);
            let counts = index
                .search_many([[0.0; 2]; 3], &Search::within(1e6))
                .unwrap();
            assert!(counts.windows(2).all(|pair| pair[0] == pair[1]));
            let searches = [
                Search::within(1e6),
                Search::within(2e6),
                Search::within(3e6),
            ];
            let counts = index.search_each([[0.0; 2]; 3], &searches).unwrap();
            assert!(counts.windows(2).all(|pair| pair[0] == pair[1]));
        }
    });
    assert_eq!(index.len().unwrap(), 40_000);
}

/// Each state has the answer of its own search, and there must be as many searches as states.
#[test]
fn each_state_has_its_own_search() {
    let index = in_memory(&"R1".parse().unwrap());
    index
        .insert_many((0..100).map(|at| [f64::from(at)]))
        .unwrap();
    let searches = [
        Search::k(3),
        Search::within(1.5),
        Search::within(40.0).tag(1, 1),
    ];
    let states = [[10.2], [20.0], [30.0]];
    let found = index.search_each(states, &searches).unwrap();
    for ((state, search), found) in states.iter().zip(&searches).zip(found) {
        assert_eq!(found, index.search(state, search).unwrap());
    }
    let error = index.search_each(states, &searches[..2]).unwrap_err();
    assert_eq!(error.to_string(), "searches: 2 of them for 3 states");
    let none: [[f64; 1]; 0] = [];
    assert!(index.search_each(none, &[]).unwrap().is_empty());
}

/// A state may use an index while it is written.
#[test]
fn a_state_may_search_while_it_is_written() {
    struct Nearest(Index);

    impl wayfold::State for Nearest {
        fn write(&self, row: &mut Vec<f64>) {
            let nearest = self.0.nearest([3.0]).unwrap().unwrap();
            row.push(nearest.distance);
        }
    }

    let index = in_memory(&"R1".parse().unwrap());
    index.insert([1.0]).unwrap();
    let id = index.insert(Nearest(index.clone())).unwrap();
    assert_eq!(index.get(id).unwrap().unwrap().state, [2.0]);
}

/// Enough points for several levels, so that searches and merges meet.
#[test]
fn equals_brute_force_after_many_points() {
    let index = in_memory(&Space::se3());
    let mut model = Model::new(index, 99);
    model.run(6_000);
}
