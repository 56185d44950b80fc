//! A shared journal that acknowledges every record, unless a test has it refused, and brings what a test sends.

mod busy_store;

use std::{collections::VecDeque, future::ready, slice, task::Context};

use futures_util::{FutureExt, future::lazy};
use parking_lot::Mutex;
use tokio::{
    sync::{oneshot, watch},
    time::{Instant, timeout},
};
use tokio_stream::wrappers::UnboundedReceiverStream;

use super::*;
use crate::{
    log::{Effects, Journal, Operation, Receipt, Uid},
    registry::{
        CommitOutcome, Registry, RegistryOptions,
        in_flight::Decision,
        settle::{SETTLE_INTERVAL, SETTLE_TIME},
    },
    testing::{self, recorded},
};

type Sent = Result<Vec<Arc<Record>>, LogError>;

#[derive(Default)]
struct RemoteJournal {
    submitted: Mutex<Vec<Arc<Record>>>,
    /// The ends at which it refuses the next records.
    ends: Mutex<VecDeque<u64>>,
    /// The newest stream.
    brings: Mutex<Option<mpsc::UnboundedSender<Sent>>>,
    /// The revision after which the newest stream begins.
    followed: watch::Sender<Option<u64>>,
}

impl Journal for RemoteJournal {
    fn submit(&self, uid: Uid, record: Arc<Record>) -> Result<Receipt, LogError> {
        if let Some(head) = self.ends.lock().pop_front() {
            return Err(LogError::fenced(uid, record.revision() - 1, head));
        }
        self.submitted.lock().push(record);
        Ok(Receipt::Awaited(ready(Ok(())).boxed()))
    }

    fn follow(&self, _: Uid, after: u64) -> RecordStream {
        let (brings, stream) = mpsc::unbounded_channel();
        *self.brings.lock() = Some(brings);
        self.followed.send_replace(Some(after));
        UnboundedReceiverStream::new(stream).boxed()
    }

    fn read(&self, _: Uid, after: Option<u64>, _: usize) -> Result<Vec<Arc<Record>>, LogError> {
        let submitted = self.submitted.lock();
        Ok(submitted[after.unwrap_or(0) as usize..].to_vec())
    }

    fn newest(&self, _: Uid) -> Result<u64, LogError> {
        Ok(self.submitted.lock().len() as u64)
    }

    fn is_shared(&self) -> bool {
        true
    }
}

struct Server {
    journal: Arc<RemoteJournal>,
    hosted: Arc<Hosted>,
    _registry: Registry,
}

impl Server {
    fn start() -> Self {
        Self::keeping(usize::MAX)
    }

    /// A server that keeps records of this many bytes.
    fn keeping(window_bytes: usize) -> Self {
        let journal = Arc::<RemoteJournal>::default();
        let options = RegistryOptions {
            window_bytes,
            ..RegistryOptions::default()
        };
        let registry = testing::registry(&journal, &recorded(0), options);
        Self {
            journal,
            hosted: registry.get("arm").unwrap(),
            _registry: registry,
        }
    }

    async fn commit(&self) {
        let writer = self.hosted.write().await.unwrap();
        let committed = self.hosted.commit(writer, effects("own")).await;
        assert_eq!(committed.unwrap(), CommitOutcome::Done);
    }

    /// Notes a record as submitted, whose receipt a test makes up.
    fn in_flight(&self, record: &Record) -> oneshot::Receiver<Decision> {
        let mut in_flight = self.hosted.in_flight.lock();
        let refusals = in_flight.refusals();
        in_flight.add(record.position(), refusals).unwrap()
    }

    /// The error of a receipt that was lost.
    fn lost(&self, record: &Record) -> LogError {
        LogError::Unconfirmed {
            uid: self.hosted.uid(),
            revision: record.revision(),
            what: "no acknowledgement in time".into(),
        }
    }

    fn brings(&self, records: &[Arc<Record>]) {
        self.sends(Ok(records.to_vec()));
    }

    fn sends(&self, sent: Sent) {
        let brings = self.journal.brings.lock().clone();
        brings.expect("a loop").send(sent).unwrap();
    }

    /// Checks that the index stops because the journal has another record of this revision.
    async fn is_replaced(&self, revision: u64) {
        let stopped = timeout(SETTLE_TIME, self.hosted.reached(u64::MAX)).await;
        let error = stopped.unwrap().err().unwrap();
        let expected = LogError::replaced(self.hosted.uid(), revision);
        assert_eq!(error.to_string(), RegistryError::Log(expected).to_string());
        assert!(self.hosted.damage().is_some());
    }
}

/// The effects of an operation without points.
fn effects(id: &str) -> Effects {
    let mut effects = Effects::new(1);
    effects.set_operation(Some(Arc::new(Operation {
        id: id.into(),
        fingerprint: [1; 32],
        response: Default::default(),
    })));
    effects
}

/// A record of another server, which the journal brings.
fn others(before: RecordPosition) -> Arc<Record> {
    Arc::new(Record::after(before, effects("other")))
}

#[tokio::test]
async fn an_acknowledged_record_does_not_wait_until_the_journal_brings_it() {
    let server = Server::start();
    for _ in 0..3 {
        server.commit().await;
    }
    let own = server.journal.submitted.lock().clone();
    let next = others(own[2].position());
    // The own ones come a second time, alone and before others.
    server.brings(&own[..1]);
    server.brings(&[&own[1..], slice::from_ref(&next)].concat());
    server.hosted.reached(4).await.unwrap();
    assert_eq!(server.hosted.published().view.position(), next.position());
    server.commit().await;
    assert_eq!(server.hosted.published().revision, 5);
}

#[tokio::test(start_paused = true)]
async fn another_record_in_the_place_of_an_acknowledged_one_is_damage() {
    for place in 0..3 {
        let server = Server::start();
        for _ in 0..3 {
            server.commit().await;
        }
        let own = server.journal.submitted.lock().clone();
        let before = own[..place].last();
        let before = before.map_or(RecordPosition::START, |last| last.position());
        server.brings(&[&own[..place], &[others(before)]].concat());
        server.is_replaced(place as u64 + 1).await;
    }
}

#[tokio::test(start_paused = true)]
async fn it_is_damage_if_only_the_newest_record_is_cached() {
    let server = Server::keeping(0);
    for _ in 0..3 {
        server.commit().await;
    }
    let own = server.journal.submitted.lock().clone();
    server.brings(&[&own[..2], &[others(own[1].position())]].concat());
    server.is_replaced(3).await;
}

#[tokio::test(start_paused = true)]
async fn applied_records_may_be_forgotten_before_the_journal_brings_them() {
    let server = Server::start();
    for _ in 0..3 {
        server.commit().await;
    }
    let mut followed = server.journal.followed.subscribe();
    server.sends(Err(LogError::trimmed(server.hosted.uid(), 0, 2)));
    let follows_again = followed.wait_for(|after| *after == Some(3));
    timeout(SETTLE_TIME, follows_again).await.unwrap().unwrap();
    let next = others(server.hosted.published().view.position());
    server.brings(slice::from_ref(&next));
    server.hosted.reached(4).await.unwrap();
    server.commit().await;
}

/// NATS answers with stale data: the records before the one without a receipt have been acknowledged since.
#[tokio::test(start_paused = true)]
async fn a_stale_end_of_the_journal_does_not_void_a_record_that_it_has() {
    let server = Server::start();
    let base = server.hosted.published().view.position();
    for _ in 0..2 {
        server.commit().await;
    }
    let hosted = &server.hosted;
    let record = others(hosted.published().view.position());
    let decision = server.in_flight(&record);
    server.journal.submitted.lock().push(Arc::clone(&record));
    let stale = LogError::fenced(hosted.uid(), 2, 1);
    let arrival = hosted.not_accepted(&record, base, stale, &mut None).await;
    server.brings(&[record]);
    arrival.unwrap().await.unwrap();
    assert!(matches!(decision.await, Ok(Decision::Published)));
}

/// NATS answers the fence with stale data, and stores the record then.
#[tokio::test(start_paused = true)]
async fn a_fence_that_a_stale_end_refuses_does_not_void_a_record_that_comes_late() {
    let server = Server::start();
    for _ in 0..2 {
        server.commit().await;
    }
    let hosted = &server.hosted;
    let base = hosted.published().view.position();
    let record = others(base);
    let decision = server.in_flight(&record);
    server.journal.ends.lock().extend([1, 2, 3]);
    let lost = server.lost(&record);
    let arrival = hosted.not_accepted(&record, base, lost, &mut None).await;
    server.brings(&[record]);
    arrival.unwrap().await.unwrap();
    assert!(matches!(decision.await, Ok(Decision::Published)));
}

/// Their message was lost.
#[tokio::test(start_paused = true)]
async fn the_records_after_a_lost_one_are_void_at_once() {
    let server = Server::start();
    server.commit().await;
    let hosted = &server.hosted;
    let base = hosted.published().view.position();
    let (mut before, mut records) = (base, Vec::new());
    for _ in 0..3 {
        records.push(others(before));
        before = records[records.len() - 1].position();
    }
    let decisions: Vec<_> = records.iter().map(|it| server.in_flight(it)).collect();
    let (began, mut void) = (Instant::now(), None);
    for (number, record) in records.iter().enumerate() {
        // The fence of the first one is taken.
        let refusals = usize::from(number > 0);
        server.journal.ends.lock().extend(vec![2; refusals]);
        let lost = server.lost(record);
        let arrival = hosted.not_accepted(record, base, lost, &mut void).await;
        drop(arrival.unwrap());
    }
    assert!(began.elapsed() < SETTLE_INTERVAL);
    let fence = server.journal.submitted.lock().last().cloned().unwrap();
    server.brings(&[fence]);
    for decision in decisions {
        assert!(matches!(decision.await, Ok(Decision::Refused)));
    }
}

#[tokio::test(start_paused = true)]
async fn a_journal_that_stays_behind_a_lost_record_is_reported() {
    let server = Server::start();
    for _ in 0..2 {
        server.commit().await;
    }
    let hosted = &server.hosted;
    let base = hosted.published().view.position();
    let record = others(base);
    server.journal.submitted.lock().pop();
    server.journal.ends.lock().extend(vec![1; 1000]);
    let lost = server.lost(&record);
    let refused = hosted.not_accepted(&record, base, lost, &mut None).await;
    let behind = RegistryError::Log(LogError::JournalBehind {
        uid: hosted.uid(),
        head: 1,
        applied: 2,
    });
    assert_eq!(refused.err(), Some(behind));
}

#[tokio::test(start_paused = true)]
async fn a_panic_of_the_loop_stops_the_index() {
    let server = Server::start();
    server.commit().await;
    let hosted = &server.hosted;
    let base = hosted.published().view.position();
    let record = others(base);
    let decision = server.in_flight(&record);
    let panics = |_: &mut Context<'_>| -> Result<(), LogError> { panic!("a bug") };
    hosted.await_receipt(AwaitedReceipt {
        record,
        base,
        outcome: lazy(panics).boxed(),
    });
    let decided = timeout(SETTLE_TIME, decision).await.unwrap().unwrap();
    // Callers go on at another server, and this one takes a copy.
    let is_of_copy =
        |why: &RegistryError| matches!(why, RegistryError::Log(LogError::CopyUnreadable { .. }));
    assert!(matches!(decided, Decision::Failed(why) if is_of_copy(&why)));
    let refused = hosted.write().await.err();
    assert!(refused.is_some_and(|why| is_of_copy(&why)));
    assert!(hosted.damage().is_some_and(|why| is_of_copy(&why)));
}
