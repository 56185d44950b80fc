//! Two servers in one process: the journal is that of the peer, so the other one cannot read what the peer has trimmed.

use std::{
    future::ready,
    sync::atomic::{AtomicUsize, Ordering::SeqCst},
};

use futures_util::{FutureExt, future::BoxFuture, stream};

use super::*;
use crate::{
    log::{Journal, MemoryLog, PointStore, RecordStream},
    registry::{Hosted, RegistryError},
    service::{
        CopyOutcome,
        member::{CopyPart, StoredRequest, StoredResponse, Unanswered},
    },
    testing::{arm, engine, forward_journal, log_with, server, submit, trim_all, unreadable},
};

const RECORDS: u64 = 20;

fn hosted(service: &Service) -> Arc<Hosted> {
    service.registry().unwrap().get("arm").unwrap()
}

/// The service and its index, which has stopped.
async fn stopped(journal: &Arc<MemoryLog>, points: &Arc<MemoryLog>) -> (Service, Stopped) {
    let service = server(journal, points);
    let failed = hosted(&service).reached(u64::MAX).await;
    assert!(failed.is_err());
    assert!(service.has_damage());
    let mut stopped = service.registry().unwrap().stopped();
    (service, stopped.pop().unwrap())
}

/// The other members by name, whose copies end after some parts.
struct Peer {
    members: Vec<(&'static str, Service)>,
    most_parts: AtomicUsize,
    /// The number of times that they were asked for a copy.
    asked: AtomicUsize,
}

impl Peer {
    fn new(service: Service) -> Self {
        Self {
            members: vec![("peer", service)],
            most_parts: AtomicUsize::new(usize::MAX),
            asked: AtomicUsize::new(0),
        }
    }
}

impl Peers for Peer {
    fn peers(&self, _: Uid) -> Vec<String> {
        let names = self.members.iter().map(|(name, _)| name.to_string());
        names.collect()
    }

    fn all(&self) -> Vec<String> {
        Vec::new()
    }

    fn wait_for_members(&self) -> BoxFuture<'_, ()> {
        ready(()).boxed()
    }

    fn stored<'a>(
        &'a self,
        _: &'a str,
        _: StoredRequest,
    ) -> BoxFuture<'a, Result<StoredResponse, Unanswered>> {
        let what = "no journal is trimmed here".into();
        ready(Err(Unanswered { what })).boxed()
    }

    fn copy<'a>(
        &'a self,
        member: &'a str,
        request: CopyRequest,
    ) -> BoxFuture<'a, Result<CopyParts, Unanswered>> {
        self.asked.fetch_add(1, SeqCst);
        let most = self.most_parts.load(SeqCst);
        let mut members = self.members.iter();
        let (_, service) = members.find(|(name, _)| *name == member).unwrap();
        async move {
            let parts = match service.copy_index(request).await.unwrap() {
                CopyOutcome::None(kind) => {
                    let only = CopyPart { kind: Some(kind) };
                    stream::iter([Ok(only)]).boxed()
                }
                CopyOutcome::Copy(copy) => stream::unfold(copy, |mut copy| async {
                    let part = copy.next().await?.unwrap();
                    Some((Ok(part), copy))
                })
                .take(most)
                .boxed(),
            };
            Ok(parts)
        }
        .boxed()
    }
}

async fn heal(service: &Service, peer: &Peer, index: &Stopped) -> Result<(), String> {
    heal_index(service.registry().unwrap(), service, peer, index).await
}

#[tokio::test(start_paused = true)]
async fn a_long_attempt_is_made_again_after_as_long() {
    let mut attempts = Attempts::starting(Duration::ZERO);
    let waits = [0, 0, 0, 0, 300, 0].map(|took| {
        attempts.failed("it ends".into(), Duration::from_secs(took));
        (attempts.next - Instant::now()).as_secs()
    });
    assert_eq!(waits, [2, 4, 8, 15, 300, 15]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_copy_that_is_cut_short_changes_nothing() {
    let entry = arm();
    let (journal, points) = (engine(&entry, RECORDS), engine(&entry, 0));
    trim_all(&journal, entry.uid);
    let peer = Peer::new(server(&journal, &journal));
    let (service, index) = stopped(&journal, &points).await;
    let mut whole = None;
    for parts in 0..100 {
        peer.most_parts.store(parts, SeqCst);
        let healed = heal(&service, &peer, &index).await;
        // An attempt does not begin a copy that broke off again.
        assert_eq!(peer.asked.load(SeqCst), parts + 1);
        if healed.is_ok() {
            whole = Some(parts);
            break;
        }
        assert_eq!(points.view(entry.uid).unwrap().revision(), 0);
        assert!(hosted(&service).damage().is_some());
    }
    // The start, the header, points in several parts, the trailer, the operations.
    assert!(whole > Some(5), "{whole:?}");
    assert!(service.registry().unwrap().stopped().is_empty() && !service.has_damage());
    let (found, expected) = (hosted(&service), hosted(&peer.members[0].1));
    let (found, operations) = tokio::task::spawn_blocking(move || found.with_operations())
        .await
        .unwrap()
        .unwrap();
    let expected = expected.published();
    assert_eq!(found.view.position(), expected.view.position());
    assert_eq!(found.view.next_id(), expected.view.next_id());
    let page = |view: &dyn crate::log::View| view.page(None, usize::MAX).unwrap();
    assert_eq!(page(&*found.view), page(&*expected.view));
    let ids = operations.iter().map(|operation| operation.id.clone());
    assert!(ids.eq((1..=RECORDS).map(|number| format!("operation {number}"))));
    // It follows the journal.
    submit(&journal, entry.uid);
    hosted(&service).reached(RECORDS + 1).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_is_not_ahead_or_has_stopped_gives_no_copy() {
    let entry = arm();
    let journal = engine(&entry, RECORDS);
    trim_all(&journal, entry.uid);
    // A server that cannot follow either.
    let (other, _) = stopped(&journal, &engine(&entry, 0)).await;
    let (service, mut index) = stopped(&journal, &engine(&entry, 0)).await;
    let why = heal(&service, &Peer::new(other), &index).await.unwrap_err();
    assert!(why.contains("has stopped following"), "{why}");

    let peer = Peer::new(server(&journal, &journal));
    index.min_revision = RECORDS + 1;
    let why = heal(&service, &peer, &index).await.unwrap_err();
    assert!(why.contains("21 is needed"), "{why}");
    index.min_revision = RECORDS;
    heal(&service, &peer, &index).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_copy_that_is_not_in_the_journal_is_not_taken() {
    let entry = arm();
    let journal = engine(&entry, RECORDS);
    trim_all(&journal, entry.uid);
    let (service, index) = stopped(&journal, &engine(&entry, 0)).await;
    let other = engine(&entry, RECORDS);
    let peer = Peer::new(server(&other, &other));
    let why = heal(&service, &peer, &index).await.unwrap_err();
    assert!(why.contains("does not have its record"), "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_contradiction_is_the_end() {
    let entry = arm();
    let journal = engine(&entry, RECORDS);
    // Its first records are others.
    for applied in [1, RECORDS - 1, RECORDS] {
        let points = engine(&entry, applied);
        let (service, peer) = (server(&journal, &points), server(&journal, &journal));
        let peer = Peer::new(peer);
        if applied < RECORDS {
            assert!(hosted(&service).reached(RECORDS).await.is_err());
        } else {
            submit(&journal, entry.uid);
            assert!(hosted(&service).reached(RECORDS + 1).await.is_err());
        }
        let registry = service.registry().unwrap();
        let index = registry.stopped().pop().unwrap();
        heal(&service, &peer, &index).await.unwrap_err();
        let why = hosted(&service).damage().unwrap();
        let RegistryError::Log(LogError::Contradicted { revision, .. }) = why else {
            panic!("{why}");
        };
        assert_eq!(revision, applied);
        assert!(registry.stopped().is_empty());
        assert_eq!(hosted(&service).published().revision, applied);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_member_that_can_compare_speaks_first() {
    let entry = arm();
    let journal = engine(&entry, RECORDS);
    let records = journal.read(entry.uid, None, usize::MAX).unwrap();
    let forgetful = engine(&entry, 0);
    forgetful.apply(entry.uid, &records).unwrap();
    trim_all(&forgetful, entry.uid);
    // The first to be asked does not know the newest record of the asker any more, and the second does.
    let peers = |remembering: &Arc<MemoryLog>| {
        let mut peers = Peer::new(server(&forgetful, &forgetful));
        let remembering = server(remembering, remembering);
        peers.members.push(("remembering", remembering));
        peers
    };
    // Its first records are others than those of the journal.
    let (service, index) = stopped(&journal, &engine(&entry, 5)).await;
    let healed = heal(&service, &peers(&journal), &index).await;
    assert!(healed.unwrap_err().contains("another record"));
    assert_eq!(hosted(&service).published().revision, 5);

    // Where no member can compare, a copy is better than none.
    let (service, index) = stopped(&journal, &engine(&entry, 5)).await;
    let healed = heal(&service, &peers(&forgetful), &index).await;
    healed.unwrap();
    assert_eq!(hosted(&service).published().revision, RECORDS);
}

#[tokio::test(flavor = "multi_thread")]
async fn points_that_cannot_be_read_are_replaced() {
    let entry = arm();
    let journal = engine(&entry, RECORDS);
    let service = server(&journal, &unreadable(&entry));
    let registry = service.registry().unwrap();
    assert!(registry.get("arm").is_err());
    let index = registry.stopped().pop().unwrap();
    // Its readers may have seen all that the journal has.
    let late = engine(&entry, 0);
    let peer = Peer::new(server(&late, &late));
    let why = heal(&service, &peer, &index).await.unwrap_err();
    assert!(why.contains("20 is needed"), "{why}");

    let peer = Peer::new(server(&journal, &journal));
    heal(&service, &peer, &index).await.unwrap();
    assert_eq!(hosted(&service).published().snapshot.len() as u64, RECORDS);
}

/// A journal that other servers share, and that stops an index because a part of its points cannot be read.
struct Stopping {
    local: Arc<MemoryLog>,
}

impl Journal for Stopping {
    forward_journal!(local);

    fn follow(&self, uid: Uid, _: u64) -> RecordStream {
        let what = "a block has another checksum".into();
        stream::once(ready(Err(LogError::Unreadable { uid, what }))).boxed()
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.local.newest(uid)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_that_cannot_be_read_is_replaced_at_the_same_revision() {
    let entry = arm();
    let local = engine(&entry, RECORDS);
    let records = local.read(entry.uid, None, usize::MAX).unwrap();
    let peer = Peer::new(server(&local, &local));
    let journal = Arc::new(Stopping { local });
    let service = server(&journal, &log_with(&entry, &records));
    let stopped = hosted(&service);
    assert!(stopped.reached(RECORDS + 1).await.is_err());
    let index = service.registry().unwrap().stopped().pop().unwrap();
    heal(&service, &peer, &index).await.unwrap();
    let healed = hosted(&service);
    assert!(!Arc::ptr_eq(&healed, &stopped));
    assert_eq!(healed.published().snapshot.len() as u64, RECORDS);
}
