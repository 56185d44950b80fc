//! A planner whose process is killed while it writes.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use wayfold::{InsertOptions, Space};
use wayfold_tests::{Process, Signal, States, bits, server};

use super::{
    SEED, content,
    history::{Content, check_copies},
    shared,
};
use crate::metrics::figures;

const KILLS: usize = 5;
/// The writes that a planner waits for before the others.
const FLUSHED: usize = 300;
const MARKER: u64 = 1;

/// The index has the first writes of each planner, at least those that it has waited for, and every copy has the same.
#[test]
fn a_killed_planner_leaves_its_first_writes() {
    let mut server = server!("--http", "127.0.0.1:0");
    let pages = server.pages();
    let space: Space = "R3".parse().unwrap();
    let survivor = shared(server.uri(), &space);
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    for _ in 0..KILLS {
        let before = content(&survivor);
        let arguments = [server.uri(), "arm"];
        let mut planner = Process::start(env!("CARGO_BIN_EXE_copy-process"), &arguments);
        assert_eq!(planner.line().as_deref(), Some("ready"));
        planner.say(&FLUSHED.to_string());
        let flushed = before.len() + FLUSHED;
        assert_eq!(planner.line(), Some(flushed.to_string()));
        planner.say("1000000");
        let seen = flushed + random.random_range(1..2_000);
        while survivor.len().unwrap() < seen {}
        planner.stop(Signal::Kill);
        // Until the server has noticed that its connection is gone.
        while figures(&pages)["wayfold_index_subscribers{index=\"arm\"}"] > 1.0 {}

        let fresh = shared(server.uri(), &space);
        let state = States::new(space.clone(), 99).row();
        let marker = InsertOptions::new().tag(MARKER);
        let marker = survivor.insert_with(&state[..], marker).unwrap().id;
        survivor.flush().unwrap();
        while fresh.get(marker).unwrap().is_none() {}
        let stored = content(&fresh);
        check_copies(&stored, &space, &[&survivor, &fresh]);
        assert!(
            before
                .iter()
                .all(|(id, point)| stored.get(id) == Some(point))
        );
        let written = stored
            .iter()
            .filter(|(id, (tag, _))| !before.contains_key(id) && *tag != MARKER);
        let written: Content = written.map(|(id, point)| (*id, point.clone())).collect();
        assert!(
            written.len() >= seen - before.len(),
            "{} points",
            written.len()
        );
        let mut states = States::new(space.clone(), 5);
        for (_, state) in written.values() {
            assert_eq!(*state, bits(&states.row()));
        }
    }
}
