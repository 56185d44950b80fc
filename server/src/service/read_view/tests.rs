//! An index of which this server has no record, because it has not followed the journal yet.

use std::{
    sync::atomic::{AtomicUsize, Ordering::SeqCst},
    time::{Duration, Instant},
};

use futures_util::{StreamExt, stream};
use tokio::sync::Mutex;

use super::*;
use crate::{
    log::{Journal, LogError, MemoryLog, RecordStream, Uid},
    service::Code,
    testing::{self, arm, forward_journal, recorded, unreadable},
};

/// A journal that other servers share, and that sends nothing yet.
struct Silent {
    local: Arc<MemoryLog>,
    oldest: Option<u64>,
    /// It does not answer while this is locked.
    gate: Mutex<()>,
    /// The number of times that it was asked for its oldest record.
    requests: AtomicUsize,
}

impl Journal for Silent {
    forward_journal!(local);

    fn follow(&self, _: Uid, _: u64) -> RecordStream {
        stream::pending().boxed()
    }

    fn oldest(&self, _: Uid) -> Result<Option<u64>, LogError> {
        self.requests.fetch_add(1, SeqCst);
        drop(self.gate.blocking_lock());
        Ok(self.oldest)
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.local.newest(uid)
    }
}

/// A server with this many records of its own.
fn server(records: u64, oldest: Option<u64>) -> (Service, Arc<Silent>) {
    server_with(&recorded(records), oldest)
}

fn server_with(local: &Arc<MemoryLog>, oldest: Option<u64>) -> (Service, Arc<Silent>) {
    let journal = Arc::new(Silent {
        local: Arc::clone(local),
        oldest,
        gate: Mutex::default(),
        requests: AtomicUsize::new(0),
    });
    (testing::server(&journal, local), journal)
}

/// A read that names no revision.
async fn read(service: &Service, call: &Call) -> Result<u64, Error> {
    let hosted = service.registry().unwrap().get("arm").unwrap();
    let published = service.published(call, &hosted, 0, false).await?;
    Ok(published.revision)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_index_whose_journal_begins_later_is_not_read_as_empty() {
    let (service, _) = server(0, Some(8));
    for _ in 0..2 {
        let refused = read(&service, &Call::default()).await.unwrap_err();
        let text = refused.to_string();
        assert!(text.contains("are held only from 7 on"), "{text}");
    }
    let index_name = || "arm".to_owned();
    let scan = v1::ScanRequest {
        index_name: index_name(),
        ..Default::default()
    };
    let watch = v1::WatchRequest {
        index_name: index_name(),
        ..Default::default()
    };
    let scanned = service.scan(&Call::default(), scan).await.err();
    let watched = service.watch(&Call::default(), watch).await.err();
    for refused in [scanned, watched] {
        let text = refused.unwrap().to_string();
        assert!(text.contains("are held only from 7 on"), "{text}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_journal_of_an_empty_index_is_asked_once() {
    for oldest in [None, Some(1)] {
        let (service, journal) = server(0, oldest);
        for _ in 0..3 {
            assert_eq!(read(&service, &Call::default()).await.unwrap(), 0);
        }
        assert_eq!(journal.requests.load(SeqCst), 1);
    }
    let (service, journal) = server(2, Some(8));
    assert_eq!(read(&service, &Call::default()).await.unwrap(), 2);
    assert_eq!(journal.requests.load(SeqCst), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_read_waits_for_the_journal_until_its_deadline() {
    let (service, journal) = server(0, None);
    let locked = journal.gate.lock().await;
    let call = Call {
        deadline: Some(Instant::now() + Duration::from_millis(20)),
        ..Call::default()
    };
    let late = read(&service, &call).await.unwrap_err();
    assert!(matches!(late, Error::DeadlineExceeded { .. }), "{late}");
    drop(locked);
    assert_eq!(read(&service, &Call::default()).await.unwrap(), 0);
}

/// The other servers of the cluster have the points.
#[tokio::test]
async fn an_index_that_cannot_be_read_here_is_to_be_asked_for_at_another_server() {
    let (service, _) = server_with(&unreadable(&arm()), None);
    let find = |is_forwarded| {
        let call = Call {
            is_forwarded,
            ..Call::default()
        };
        service.index(&call, Role::Read, "arm", "").err().unwrap()
    };
    let refused = find(false);
    assert_eq!(refused.code(), Code::Unavailable);
    let text = refused.to_string();
    assert!(text.contains("call another server"), "{text}");
    // The server that forwarded the call evaluates it, because nothing took place.
    assert_eq!(find(true).reason(), "INDEX_NOT_FOUND");
}

/// This server knows that the other index was deleted: the server that forwarded the call has not heard of it.
#[tokio::test]
async fn a_forwarded_call_finds_the_index_that_took_the_place_of_its_own() {
    let (service, _) = server(0, None);
    let call = Call {
        is_forwarded: true,
        forwarded_uid: Some(Uid::unique()),
        ..Call::default()
    };
    assert!(service.index(&call, Role::Write, "arm", "").is_ok());
}

#[tokio::test]
async fn another_uid_is_refused_with_the_one_of_the_index() {
    let (service, _) = server(0, None);
    let hosted = service.registry().unwrap().get("arm").unwrap();
    let mismatch = Error::UidMismatch {
        index: "arm".into(),
        requested: "another".into(),
        found: hosted.uid().to_string(),
    };
    assert_eq!(check_uid(&hosted, "another"), Err(mismatch));
}
