//! Eight planner processes share one index: each of their answers equals brute force at the revision it names.

use std::collections::BTreeSet;

use wayfold_proto::v1::InsertRequest;
use wayfold_tests::{Content, Model, Process, Stubs, ledger, ledger::Entry, row_states, server};

const PLANNERS: usize = 8;
const ROUNDS: usize = 120;

#[tokio::test]
async fn eight_planner_processes_share_one_index() {
    for space in ["R3*SO3:0.15", "ompl-se3"] {
        shared(space).await;
    }
}

async fn shared(space: &str) {
    let server = server!();
    let mut stubs = Stubs::connect(server.uri()).await;
    stubs.create("roadmap", space).await;
    let space = space.parse().expect("a space");
    let mut model = Model::new(space);
    // Assigned ids are above this one, the planners' own ids below.
    let root = InsertRequest {
        index_name: "roadmap".into(),
        states: Some(row_states(&[5.0, 5.0, 5.0, 0.0, 0.0, 0.0, 1.0], 7)),
        ids: vec![1 << 48],
        ..Default::default()
    };
    let rooted = stubs.insert(root.clone()).await;
    model.insert(&root, &rooted);

    let directory = tempfile::tempdir().unwrap();
    let ledgers: Vec<_> = (0..PLANNERS)
        .map(|i| directory.path().join(format!("{i}.ledger")))
        .collect();
    let mut planners: Vec<Process> = ledgers
        .iter()
        .enumerate()
        .map(|(seed, ledger)| {
            let (seed, rounds) = (seed.to_string(), ROUNDS.to_string());
            let ledger = ledger.to_str().unwrap();
            Process::start(
                env!("CARGO_BIN_EXE_planner-process"),
                &[server.uri(), "roadmap", &seed, &rounds, ledger],
            )
        })
        .collect();
    for planner in &mut planners {
        assert_eq!(planner.line().as_deref(), Some("ready"));
    }
    for planner in &mut planners {
        planner.say("go");
    }
    for planner in planners {
        let finished = planner.finish();
        assert!(finished.status.success(), "{}", finished.stderr);
    }

    // At each revision the mutation comes first, because the other answers saw its result.
    let mut entries: Vec<(usize, Entry)> = ledgers
        .iter()
        .enumerate()
        .flat_map(|(i, path)| ledger::read(path).into_iter().map(move |entry| (i, entry)))
        .collect();
    assert_eq!(entries.len(), PLANNERS * ROUNDS);
    entries.sort_by_key(|(_, entry)| (entry.revision(), !entry.changed()));
    for (_, entry) in &entries {
        model.check(entry);
    }
    model.check_content(&Content::read(&stubs, "roadmap").await.unwrap());

    // The planners ran concurrently: a run of revisions by one planner is short.
    let authors: Vec<usize> = entries
        .iter()
        .filter(|(_, entry)| entry.changed())
        .map(|(author, _)| *author)
        .collect();
    assert_eq!(authors.len() as u64 + 1, model.revision());
    assert_eq!(BTreeSet::from_iter(&authors).len(), PLANNERS);
    let handovers = authors.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!(handovers > 2 * PLANNERS, "{handovers} handovers");
}
