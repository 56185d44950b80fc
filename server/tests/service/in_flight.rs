//! Mutations are evaluated while earlier ones are under way: some published, some not.

use std::collections::BTreeSet;

use wayfold_proto::v1;

use crate::{
    remote::{Stream, named_arm, server, settled},
    support::*,
};

/// An insert of one state that asks for its neighbours.
fn asking(state: f64, k: u32) -> v1::InsertRequest {
    v1::InsertRequest {
        neighbor_spec: Some(v1::NeighborSpec {
            k_form: nearest(k),
            ..Default::default()
        }),
        ..insertion(&[[state]], &[])
    }
}

/// The overlay of the pending records keeps a published one for as long as it has others that are not.
#[tokio::test]
async fn a_point_that_was_published_a_moment_ago_is_one_neighbor() {
    let (stream, entry) = (Stream::new(8, 0.0), named_arm());
    let (service, _, remote) = server(&stream, &entry);
    let held = remote.hold().await;
    let insert = |state| {
        let service = service.clone();
        tokio::spawn(async move { service.insert(&CALL, asking(state, 5)).await.unwrap() })
    };
    let mut calls = Vec::new();
    for state in [0.0, 10.0, 20.0, 30.0] {
        calls.push(insert(state));
        yields().await;
    }
    // The first two records are published, the others are not.
    remote.let_pass(2);
    yields().await;
    assert_eq!(info(&service, "arm").await.revision.number(), 2);
    let last = insert(0.5);
    yields().await;
    drop(held);
    let neighbors = last.await.unwrap().neighbors.unwrap();
    assert_eq!(neighbors.ids, [0, 1, 2, 3]);
    assert_eq!(neighbors.distances, [0.5, 9.5, 19.5, 29.5]);
    for call in calls {
        call.await.unwrap();
    }
}

/// A writer evaluates against its records under way, and a server that starts later reads them all.
#[tokio::test]
async fn records_under_way_are_seen_by_the_next_mutation_and_by_no_reader() {
    let (stream, entry) = (Stream::new(6, 0.0), named_arm());
    let (one, _, held) = server(&stream, &entry);
    let turns = held.hold().await;
    let calls = (0..3u64).map(|at| {
        let service = one.clone();
        let request = v1::InsertRequest {
            min_separation: 0.5,
            ..insertion(&[[0.1 * at as f64]], &[])
        };
        tokio::spawn(async move { service.insert(&CALL, request).await.unwrap() })
    });
    let calls: Vec<_> = calls.collect();
    yields().await;
    assert_eq!(everything(&one).await.point_count, 0);
    drop(turns);
    let mut outcomes = Vec::new();
    for call in calls {
        outcomes.push(call.await.unwrap().outcomes[0]);
    }
    let close = v1::Outcome::TooClose as i32;
    assert_eq!(outcomes, [v1::Outcome::Inserted as i32, close, close]);
    let (late, ..) = server(&stream, &entry);
    settled(&stream, &entry, &[&one, &late]).await;
}

/// Equal mutations of two servers in one millisecond are two mutations.
#[tokio::test]
async fn equal_inserts_at_two_servers_get_ids_of_their_own() {
    let (stream, entry) = (Stream::new(7, 0.0), named_arm());
    let servers = [0, 1].map(|_| server(&stream, &entry));
    let mut ids = BTreeSet::new();
    for _ in 0..50 {
        let inserts = servers.each_ref().map(|(service, ..)| {
            let service = service.clone();
            tokio::spawn(async move {
                let inserted = service.insert(&CALL, insertion(&[[0.5]], &[])).await;
                inserted.unwrap().ids[0]
            })
        });
        for insert in inserts {
            ids.insert(insert.await.unwrap());
        }
    }
    assert_eq!(ids.len(), 100);
    let services = servers.each_ref().map(|(service, ..)| service);
    settled(&stream, &entry, &services).await;
}

/// Lets the other tasks run until they wait.
async fn yields() {
    for _ in 0..100 {
        tokio::task::yield_now().await;
    }
}
