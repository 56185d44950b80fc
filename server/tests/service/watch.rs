//! A subscriber of an index sees each mutation once, in order, complete, and not before readers do.

use std::{collections::BTreeMap, pin::pin, sync::Arc, time::Duration};

use bytes::Bytes;
use futures_util::poll;
use prost::Message;
use wayfold_index::Space;
use wayfold_proto::v1::{self, ResetReason};
use wayfold_server::{
    log::MemoryLog,
    registry::RegistryOptions,
    service::{Call, Code, Limits, Service, Watch},
};

use crate::{random::Requests, support::*};

async fn message(watch: &mut Watch) -> v1::WatchResponse {
    watch.next().await.unwrap().unwrap()
}

/// A subscriber's knowledge: each point with its state, tag, revision and payload.
#[derive(Default)]
struct Subscriber {
    points: BTreeMap<u64, (Vec<f64>, u64, u64, Bytes)>,
    revision: u64,
    /// The pieces of the next mutation.
    pieces: Vec<v1::Mutation>,
}

impl Subscriber {
    fn take(&mut self, message: v1::WatchResponse) {
        assert_eq!(message.reset(), ResetReason::Unspecified);
        for mutation in message.mutations {
            assert_eq!(mutation.revision.number(), self.revision + 1);
            let continued = mutation.continued;
            self.pieces.push(mutation);
            if continued {
                continue;
            }
            self.revision += 1;
            for piece in std::mem::take(&mut self.pieces) {
                for id in piece.removed_ids {
                    assert!(self.points.remove(&id).is_some());
                }
                let Some(stored) = piece.stored else {
                    continue;
                };
                let states = stored.states.unwrap();
                let width = states.coordinates.len() / states.row_count as usize;
                for (slot, row) in states.coordinates.chunks(width).enumerate() {
                    let (tag, revision) = (stored.tags[slot], stored.revisions[slot]);
                    assert!(revision <= self.revision);
                    let point = (row.to_vec(), tag, revision, stored.payloads[slot].clone());
                    self.points.insert(stored.ids[slot], point);
                }
            }
        }
    }

    async fn follow(&mut self, watch: &mut Watch, revision: u64) {
        while self.revision < revision {
            self.take(message(watch).await);
        }
    }

    async fn check(&self, service: &Service) {
        let all = everything(service).await;
        assert_eq!(all.revision.number(), self.revision);
        let points = all.points.unwrap();
        let states = points.states.unwrap().coordinates;
        assert!(points.ids.iter().eq(self.points.keys()));
        for (slot, (row, tag, revision, payload)) in self.points.values().enumerate() {
            assert_eq!(states[slot * row.len()..][..row.len()], row[..]);
            assert_eq!(
                (points.tags[slot], points.revisions[slot]),
                (*tag, *revision)
            );
            assert_eq!(points.payloads[slot], payload);
        }
    }
}

#[tokio::test]
async fn the_mutations_amount_to_the_points_wherever_one_begins() {
    for seed in 0..8 {
        println!("seed {seed}");
        let (service, uid) = arm("R2*SO2").await;
        let space: Space = "R2*SO2".parse().unwrap();
        let mut requests = Requests::new(seed, &space, &uid);
        let mut watch = service.watch(&CALL, watching(&uid, 0)).await.unwrap();
        let first = message(&mut watch).await;
        assert_eq!(
            (
                first.revision.number(),
                first.mutations.len(),
                first.revision.uid()
            ),
            (0, 0, uid.clone())
        );
        let mut subscriber = Subscriber::default();
        let mut late: Vec<(Subscriber, u64)> = Vec::new();
        for step in 0..60 {
            let revision = info(&service, "arm").await.revision.number();
            // Refused mutations are part of the history too.
            match step % 4 {
                0..=1 => drop(service.insert(&CALL, requests.insert(revision)).await),
                2 => drop(service.update(&CALL, requests.update(revision)).await),
                _ => drop(service.remove(&CALL, requests.remove()).await),
            }
            let revision = info(&service, "arm").await.revision.number();
            if step % 7 == 0 {
                subscriber.follow(&mut watch, revision).await;
                subscriber.check(&service).await;
                let points = subscriber.points.clone();
                let pieces = Vec::new();
                late.push((
                    Subscriber {
                        points,
                        revision,
                        pieces,
                    },
                    revision,
                ));
            }
        }
        let last = info(&service, "arm").await.revision.number();
        for (mut subscriber, from) in late {
            let mut watch = service.watch(&CALL, watching(&uid, from)).await.unwrap();
            assert_eq!(message(&mut watch).await.revision.number(), last);
            subscriber.follow(&mut watch, last).await;
            subscriber.check(&service).await;
        }
    }
}

#[tokio::test]
async fn a_large_mutation_comes_in_pieces_that_fit() {
    let limits = Limits {
        max_answer_bytes: 20_000,
        ..Limits::default()
    };
    let (service, uid) = arm_with("R3", limits).await;
    let large = v1::InsertRequest {
        payloads: (0..300u32)
            .map(|at| vec![at as u8; at as usize].into())
            .collect(),
        ..insertion(&cube(1, 300), &(0..300).collect::<Vec<_>>())
    };
    service.insert(&CALL, large).await.unwrap();
    let ids: Vec<u64> = (0..300).filter(|id| id % 7 > 0).collect();
    service.remove(&CALL, removal(&ids)).await.unwrap();
    insert_rows(&service, &cube(2, 1), &[]).await;
    let mut watch = service.watch(&CALL, watching(&uid, 0)).await.unwrap();
    let mut subscriber = Subscriber::default();
    let mut pieces = 0;
    while subscriber.revision < 3 {
        let message = message(&mut watch).await;
        assert!(message.encoded_len() <= 20_000, "{}", message.encoded_len());
        pieces += message.mutations.len();
        subscriber.take(message);
    }
    assert!(pieces > 5, "{pieces}");
    subscriber.check(&service).await;
}

#[tokio::test]
async fn forgotten_records_become_a_reset() {
    let log = Arc::new(MemoryLog::new());
    let options = RegistryOptions {
        window_bytes: 0,
        ..options()
    };
    let restart = || restarted_with(Arc::clone(&log), options, Limits::default());
    let service = restart();
    let uid = create(&service, "arm", "R1").await;
    for id in 0..4 {
        insert_rows(&service, &[[1.0]], &[id]).await;
    }
    // A subscriber that starts again receives only the newest mutation.
    let service = restart();
    let mut watch = service.watch(&CALL, watching(&uid, 3)).await.unwrap();
    assert_eq!(message(&mut watch).await.mutations, []);
    assert_eq!(message(&mut watch).await.mutations[0].revision.number(), 4);
    let mut watch = service.watch(&CALL, watching(&uid, 2)).await.unwrap();
    assert_eq!(message(&mut watch).await.reset(), ResetReason::Unspecified);
    let reset = message(&mut watch).await;
    assert_eq!(
        (reset.reset(), reset.revision.number()),
        (ResetReason::WindowPassed, 4)
    );
    assert!(watch.next().await.is_none());

    delete(&service, "arm").await;
    let other = create(&service, "arm", "R1").await;
    let mut watch = service.watch(&CALL, watching(&uid, 4)).await.unwrap();
    let reset = message(&mut watch).await;
    assert_eq!(
        (reset.reset(), reset.revision.uid()),
        (ResetReason::UidChanged, other)
    );
    assert!(watch.next().await.is_none());
}

#[tokio::test]
async fn a_watch_ends_with_its_index_its_deadline_and_its_server() {
    let (service, uid) = arm("R1").await;
    let unnamed = watching("", 0);
    let refused = service.watch(&CALL, unnamed).await;
    assert_eq!(refused.err().unwrap().reason(), "REQUIRED");
    let now = v1::WatchRequest {
        after_revision: None,
        ..watching("", 0)
    };
    let mut waiting = Vec::new();
    for deadline in [
        None,
        Some(std::time::Instant::now() + Duration::from_millis(1)),
        None,
    ] {
        let call = Call {
            deadline,
            ..Call::default()
        };
        waiting.push(service.watch(&call, now.clone()).await.unwrap());
    }
    for watch in &mut waiting {
        assert_eq!(message(watch).await.revision.uid(), uid);
    }
    let late = waiting[1].next().await.unwrap();
    assert_eq!(refusal(late).0, Code::DeadlineExceeded);
    assert!(waiting[1].next().await.is_none());
    {
        let mut next = pin!(waiting[0].next());
        assert!(poll!(&mut next).is_pending());
        delete(&service, "arm").await;
        assert_eq!(refusal(next.await.unwrap()).0, Code::NotFound);
    }
    create(&service, "arm", "R1").await;
    let mut watch = service.watch(&CALL, now).await.unwrap();
    message(&mut watch).await;
    let mut next = pin!(watch.next());
    assert!(poll!(&mut next).is_pending());
    service.begin_shutdown();
    assert_eq!(refusal(next.await.unwrap()).0, Code::Unavailable);
}
