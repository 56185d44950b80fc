//! Sessions write through two servers that share a journal, which loses requests and answers.

use std::collections::BTreeMap;

use futures_util::future::join_all;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::remote::{Stream, named_arm, server, settled};

/// An operator sees a batch from its arrival until it is acknowledged, and its retries too.
#[tokio::test]
async fn batches_that_wait_for_the_journal_are_under_way() {
    let (stream, entry) = (Stream::new(3, 0.0), named_arm());
    let (service, registry, remote) = server(&stream, &entry);
    let (session, _) = open(&service, &entry.uid.to_string(), 1).await;
    let hosted = registry.get("arm").unwrap();
    assert_eq!(hosted.batches_under_way(), 0);
    let held = remote.hold().await;
    let put = batch(&session, 1, &[Put(session.first, 0.5)]);
    let mut twins = [(); 2].map(|()| Box::pin(write(&service, put.clone())));
    for twin in &mut twins {
        assert!(futures_util::poll!(twin.as_mut()).is_pending());
    }
    assert_eq!(hosted.batches_under_way(), 2);
    drop(held);
    let [first, second] = twins;
    assert_eq!(first.await, second.await);
    assert_eq!(hosted.batches_under_way(), 0);
}

/// A batch, and the response that the writer was given.
type Acknowledged = (v1::WriteRequest, v1::WriteResponse);

/// Writes each batch through either server and repeats it at either, while it is under way and afterwards. Returns the
/// batches in their order, and the points that the writer expects under its own ids.
async fn batches(
    servers: [Service; 2],
    uid: String,
    seed: u64,
) -> (u64, Vec<Acknowledged>, BTreeMap<u64, f64>) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (session, _) = open(&servers[random.random_range(0..2)], &uid, 5).await;
    let (mut ids, mut points) = (
        Vec::from_iter((0..5).map(|at| session.first + at)),
        BTreeMap::new(),
    );
    let mut acknowledged: Vec<Acknowledged> = Vec::new();
    for number in 1..=30 {
        let steps: Vec<Step> = (0..random.random_range(0..6))
            .map(|_| {
                let id = ids[random.random_range(0..ids.len())];
                match random.random_range(0..3) {
                    0 => Remove(id),
                    1 => Tag(id, number),
                    _ => Put(id, random.random()),
                }
            })
            .collect();
        let mut request = batch(&session, number, &steps);
        request.reserve_count = random.random_range(0..3);
        let mut missing = 0;
        for step in steps {
            match step {
                Put(id, row) => drop(points.insert(id, row)),
                Remove(id) => missing += u64::from(points.remove(&id).is_none()),
                Tag(id, _) => missing += u64::from(!points.contains_key(&id)),
            }
        }
        let twins = [(); 2].map(|()| random.random_range(0..2));
        let twins = twins.map(|at: usize| write(&servers[at], request.clone()));
        let responses = join_all(twins).await;
        assert_eq!(responses[0], responses[1]);
        let response = responses[0].clone();
        assert_eq!(response.missing_count, missing);
        let block = response.reserved.unwrap();
        assert_eq!(block.id_count, request.reserve_count);
        ids.extend((0..block.id_count).map(|at| block.first_id + at));
        let server = &servers[random.random_range(0..2)];
        assert_eq!(write(server, request.clone()).await, response);
        acknowledged.push((request, response));
    }
    (session.id, acknowledged, points)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_batch_takes_effect_once_across_servers() {
    for (seed, loses) in [(1, 0.0), (2, 0.1), (3, 0.3), (4, 0.3)] {
        let (stream, entry) = (Stream::new(seed, loses), named_arm());
        let (one, ..) = server(&stream, &entry);
        let (other, ..) = server(&stream, &entry);
        let uid = entry.uid.to_string();
        let writers = (0..5u64).map(|writer| {
            let servers = [one.clone(), other.clone()];
            tokio::spawn(batches(servers, uid.clone(), seed << 8 | writer))
        });
        let writers: Vec<_> = writers.collect();
        let mut expected = BTreeMap::new();
        let mut acknowledged = BTreeMap::new();
        for writer in writers {
            let (session, batches, points) = writer.await.unwrap();
            for (id, state) in points {
                assert_eq!(expected.insert(id, state), None, "id {id} was given twice");
            }
            acknowledged.insert(session, batches);
        }
        let found = settled(&stream, &entry, &[&one, &other]).await;
        let rows = found.states.unwrap().coordinates;
        assert_eq!(
            found.ids.into_iter().zip(rows).collect::<BTreeMap<_, _>>(),
            expected
        );

        // The records have each session's batches once, in their order, at the revisions of the responses.
        let mut recorded: BTreeMap<u64, u64> = BTreeMap::new();
        for record in stream.records(entry.uid) {
            let Some(batch) = record.effects().batch() else {
                continue;
            };
            assert_eq!(
                batch.number,
                recorded.get(&batch.session).map_or(0, |newest| newest + 1)
            );
            recorded.insert(batch.session, batch.number);
            if let Some(at) = batch.number.checked_sub(1) {
                let (_, response) = &acknowledged[&batch.session][at as usize];
                assert_eq!(response.revision.number(), record.revision());
            }
        }
        // A session whose opening was repeated after a lost answer would have no writer.
        let written = acknowledged
            .iter()
            .map(|(id, batches)| (*id, batches.len() as u64));
        assert_eq!(recorded, written.collect());
    }
}

/// The records of two such calls may differ in nothing but their origin.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_servers_never_open_the_same_session() {
    let (stream, entry) = (Stream::new(5, 0.0), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, ..) = server(&stream, &entry);
    let uid = entry.uid.to_string();
    let mut ids = BTreeMap::new();
    for _ in 0..50 {
        let (one, other) = tokio::join!(open(&one, &uid, 2), open(&other, &uid, 2));
        for (session, _) in [one, other] {
            assert_eq!(ids.insert(session.id, session.first), None);
        }
    }
    let blocks: Vec<u64> = ids.into_values().collect();
    assert_eq!(blocks, Vec::from_iter((0..200).step_by(2)));
}

/// A server reads the journal to its end before it refuses a batch.
#[tokio::test]
async fn a_server_that_lags_behind_the_journal_refuses_no_good_batch() {
    let (stream, entry) = (Stream::new(6, 0.0), named_arm());
    let (one, ..) = server(&stream, &entry);
    let (other, _, journal) = server(&stream, &entry);
    let uid = entry.uid.to_string();
    journal.fall_behind();
    let (session, _) = open(&one, &uid, 5).await;
    let put = |number| batch(&session, number, &[Put(session.first, number as f64)]);
    write(&other, put(1)).await;
    journal.fall_behind();
    write(&one, put(2)).await;
    write(&other, put(3)).await;
    journal.fall_behind();
    write(&one, put(4)).await;
    let refused = other.write(&CALL, put(6)).await.unwrap_err();
    assert_eq!(refused.reason(), "BATCH_OUT_OF_ORDER");
    assert!(
        refused.to_string().contains("newest batch is 4"),
        "{refused}"
    );
    write(&other, put(5)).await;
    settled(&stream, &entry, &[&one, &other]).await;
}
