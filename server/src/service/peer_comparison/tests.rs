mod resumed;

use std::{
    future::ready,
    sync::atomic::{AtomicU64, AtomicUsize, Ordering::SeqCst},
};

use bytes::Bytes;
use futures_util::{FutureExt, StreamExt, future::BoxFuture, stream};
use parking_lot::Mutex;
use tokio::{
    sync::{Notify, watch},
    time::interval,
};
use wayfold_proto::v1;

use super::*;
use crate::{
    log::{Entry, Journal, LogError, MemoryLog, PointStore, Record, RecordStream, Uid},
    service::{
        Code, NotForwarded, Owners,
        member::{CopyParts, CopyRequest, StoredResponse, Unanswered},
    },
    testing::{self, arm, forward_journal, log_with, more},
};

const RECORDS: u64 = 4;

/// The others of a cluster, by what each has applied; None for one that does not answer.
struct OtherMembers {
    changes: AtomicU64,
    requests: AtomicUsize,
    members: Mutex<Vec<Option<Arc<MemoryLog>>>>,
    /// False while the members are not known yet.
    are_heard: watch::Sender<bool>,
    /// False while they do not answer.
    are_answering: watch::Sender<bool>,
}

impl Owners for OtherMembers {
    fn owner(&self, _: Uid) -> Option<String> {
        None
    }

    fn members(&self) -> usize {
        self.members.lock().len() + 1
    }

    fn changes(&self) -> u64 {
        self.changes.load(SeqCst)
    }

    fn forward<'a>(
        &'a self,
        _: &'a str,
        _: Uid,
        _: &'static str,
        _: &'a Call,
        _: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, NotForwarded>> {
        ready(Err(NotForwarded::Unsent)).boxed()
    }
}

impl Peers for OtherMembers {
    fn peers(&self, _: Uid) -> Vec<String> {
        self.all()
    }

    fn all(&self) -> Vec<String> {
        let members = 0..self.members.lock().len();
        members.map(|number| number.to_string()).collect()
    }

    fn wait_for_members(&self) -> BoxFuture<'_, ()> {
        let mut are_heard = self.are_heard.subscribe();
        async move { drop(are_heard.wait_for(|it| *it).await) }.boxed()
    }

    fn stored<'a>(
        &'a self,
        member: &'a str,
        request: StoredRequest,
    ) -> BoxFuture<'a, Result<StoredResponse, Unanswered>> {
        self.requests.fetch_add(1, SeqCst);
        let number: usize = member.parse().unwrap();
        let Some(points) = self.members.lock()[number].clone() else {
            let what = "it is busy".into();
            return ready(Err(Unanswered { what })).boxed();
        };
        let mut are_answering = self.are_answering.subscribe();
        async move {
            drop(are_answering.wait_for(|it| *it).await);
            let uid: Uid = request.uids[0].parse().unwrap();
            let position = PointStore::view(&*points, uid).unwrap().position();
            let kept = points.retained(uid, request.revisions[0]).unwrap();
            let index = StoredIndex {
                uid: request.uids[0].clone(),
                revision: position.revision,
                is_durable: false,
                oldest: None,
                applied: Some(position.into()),
                requested: kept.map(|kept| kept.position().into()),
            };
            Ok(StoredResponse {
                indexes: vec![index],
            })
        }
        .boxed()
    }

    fn copy<'a>(
        &'a self,
        _: &'a str,
        _: CopyRequest,
    ) -> BoxFuture<'a, Result<CopyParts, Unanswered>> {
        let what = "no copy is asked for".into();
        ready(Err(Unanswered { what })).boxed()
    }
}

/// A journal that other servers share.
struct Shared {
    log: Arc<MemoryLog>,
    /// A notification ends the follower's records: the journal ends before what the server has applied.
    is_set_back: Arc<Notify>,
}

impl Journal for Shared {
    forward_journal!(log);

    fn follow(&self, uid: Uid, after: u64) -> RecordStream {
        let is_set_back = Arc::clone(&self.is_set_back);
        let behind = LogError::JournalBehind {
            uid,
            head: after,
            applied: after + 1,
        };
        let records = self.log.follow(uid, after);
        let records = records.take_until(async move { is_set_back.notified().await });
        records.chain(stream::iter([Err(behind)])).boxed()
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.log.newest(uid)
    }
}

/// A server that has applied some records, and the others.
struct Server {
    service: Service,
    own: Arc<MemoryLog>,
    is_set_back: Arc<Notify>,
    others: Arc<OtherMembers>,
}

impl Server {
    fn new(entry: &Entry, records: &[Arc<Record>]) -> Self {
        let own = log_with(entry, records);
        let is_set_back = Arc::<Notify>::default();
        let journal = Shared {
            log: Arc::clone(&own),
            is_set_back: Arc::clone(&is_set_back),
        };
        let service = testing::server(&Arc::new(journal), &own);
        let others = Arc::new(OtherMembers {
            changes: AtomicU64::new(1),
            requests: AtomicUsize::new(0),
            members: Mutex::default(),
            are_heard: watch::Sender::new(true),
            are_answering: watch::Sender::new(true),
        });
        service.set_owners(Arc::clone(&others) as Arc<dyn Owners>);
        service.set_peers(Arc::clone(&others) as Arc<dyn Peers>);
        Self {
            service,
            own,
            is_set_back,
            others,
        }
    }

    fn set(&self, members: Vec<Option<Arc<MemoryLog>>>) {
        *self.others.members.lock() = members;
        self.others.changes.fetch_add(1, SeqCst);
    }

    async fn insert(&self) -> Result<u64, Error> {
        self.insert_into("arm").await
    }

    async fn insert_into(&self, index: &str) -> Result<u64, Error> {
        let states = v1::States {
            row_count: 1,
            coordinates: vec![0.5],
        };
        let request = v1::InsertRequest {
            index_name: index.into(),
            states: Some(states),
            ..Default::default()
        };
        let inserted = self.service.insert(&Call::default(), request).await?;
        Ok(inserted.revision.unwrap().number)
    }
}

#[tokio::test]
async fn the_members_are_asked_once_until_they_change() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    // One that is behind, one that is equal, and one that does not answer.
    let behind = log_with(&entry, &records[..2]);
    server.set(vec![Some(behind), Some(log_with(&entry, &records)), None]);
    for written in 1..=3 {
        assert_eq!(server.insert().await.unwrap(), RECORDS + written);
        assert_eq!(server.others.requests.load(SeqCst), 3);
    }
    server.others.changes.fetch_add(1, SeqCst);
    server.insert().await.unwrap();
    assert_eq!(server.others.requests.load(SeqCst), 6);
}

#[tokio::test]
async fn a_contradiction_stops_writing() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    // The member is behind, at the same revision, or ahead.
    for count in [1, 2, 5] {
        let other = more(&records[..2], 2, count);
        server.set(vec![Some(log_with(&entry, &other))]);
        for _ in 0..2 {
            let refused = server.insert().await.unwrap_err();
            assert_eq!(refused.code(), Code::DataLoss, "{refused}");
            let revision = other.len().min(records.len());
            let text = format!("0 has applied another record of revision {revision}");
            assert!(refused.to_string().contains(&text), "{refused}");
        }
    }
}

/// A server that starts waits for the announcements of the others: an empty list does not mean that there are none.
#[tokio::test(start_paused = true)]
async fn the_first_mutation_waits_until_the_members_are_known() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    server.others.are_heard.send_replace(false);
    let waiting = timeout(Duration::from_secs(60), server.insert());
    assert!(waiting.await.is_err());
    server.set(vec![Some(log_with(&entry, &more(&records[..2], 2, 1)))]);
    server.others.are_heard.send_replace(true);
    let refused = server.insert().await.unwrap_err();
    assert_eq!(refused.code(), Code::DataLoss, "{refused}");
}

/// A comparison goes on without the call that began it, so that calls with short deadlines get their turn.
#[tokio::test(start_paused = true)]
async fn a_call_that_leaves_does_not_end_the_comparison() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    server.set(vec![Some(log_with(&entry, &records))]);
    server.others.are_heard.send_replace(false);
    assert!(
        timeout(Duration::from_millis(1), server.insert())
            .await
            .is_err()
    );
    server.others.are_heard.send_replace(true);
    while server.others.requests.load(SeqCst) == 0 {
        tokio::task::yield_now().await;
    }
    server.insert().await.unwrap();
    assert_eq!(server.others.requests.load(SeqCst), 1);
}

#[tokio::test(start_paused = true)]
async fn a_mutation_waits_for_the_records_of_a_member_that_is_ahead() {
    let entry = arm();
    let all = more(&[], 1, RECORDS + 1);
    let server = Server::new(&entry, &all[..RECORDS as usize]);
    server.set(vec![Some(log_with(&entry, &all))]);
    // Two that come together wait together.
    let began = Instant::now();
    let (one, other) = tokio::join!(server.insert(), server.insert());
    assert!(began.elapsed() < 2 * ARRIVAL_TIME);
    for refused in [one.unwrap_err(), other.unwrap_err()] {
        assert_eq!(refused.code(), Code::Unavailable, "{refused}");
        assert!(refused.to_string().contains("revision 5"), "{refused}");
    }

    let repaired = async {
        while server.others.requests.load(SeqCst) < 2 {
            tokio::task::yield_now().await;
        }
        server.own.submit(entry.uid, Arc::clone(&all[4])).unwrap();
    };
    let (inserted, ()) = tokio::join!(server.insert(), repaired);
    assert_eq!(inserted.unwrap(), RECORDS + 2);
}

/// Its points are in no journal. The member does not answer, and is not live in the end.
#[tokio::test(start_paused = true)]
async fn a_restored_index_takes_no_mutation_while_it_waits_for_a_copy() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    server.set(vec![None]);
    let (service, call) = (&server.service, Call::default());
    let request = v1::SnapshotIndexRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    let mut snapshot = service.snapshot_index(&call, request).await.unwrap();
    let mut restoring = service.restore_index(&call).unwrap();
    while let Some(part) = snapshot.next().await {
        let name = "leg".into();
        let part = part.unwrap().part;
        let message = v1::RestoreIndexRequest { name, part };
        restoring.add(message).await.unwrap();
    }
    // The caller leaves, and the wait goes on.
    let finishing = timeout(Duration::from_secs(1), restoring.finish());
    assert!(finishing.await.is_err());
    let refused = server.insert_into("leg").await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    let what = "no other server has its points yet";
    assert!(refused.to_string().contains(what), "{refused}");
    server.insert().await.unwrap();

    server.set(Vec::new());
    let inserted = async {
        let mut attempts = interval(Duration::from_millis(10));
        loop {
            attempts.tick().await;
            if let Ok(revision) = server.insert_into("leg").await {
                return revision;
            }
        }
    };
    let inserted = timeout(Duration::from_secs(1), inserted).await;
    assert_eq!(inserted.unwrap(), RECORDS + 1);
}

/// It makes a record too.
#[tokio::test(start_paused = true)]
async fn a_latest_read_compares_again_if_the_members_change_while_it_waits() {
    let (entry, records) = (arm(), more(&[], 1, RECORDS));
    let server = Server::new(&entry, &records);
    let hosted = server.service.registry().unwrap().get("arm").unwrap();
    let writer = hosted.write().await.unwrap();
    let call = Call::default();
    let mut read = Box::pin(server.service.published(&call, &hosted, 0, true));
    let waited = timeout(Duration::from_millis(1), read.as_mut()).await;
    assert!(waited.is_err() && server.service.is_compared(&hosted));
    server.set(vec![Some(log_with(&entry, &more(&records[..2], 2, 2)))]);
    drop(writer);
    let refused = read.await.err().unwrap();
    assert_eq!(refused.code(), Code::DataLoss, "{refused}");
    assert_eq!(server.own.newest(entry.uid).unwrap(), RECORDS);
}
