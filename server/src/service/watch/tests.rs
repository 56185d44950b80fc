//! A watch at a server whose journal has lost records that the server has applied, or has others in their place.

use futures_util::{StreamExt, stream};

use super::*;
use crate::{
    log::{Journal, Receipt, RecordStream, Uid},
    service::Code,
    testing::{self, arm, log_with, more},
};

/// A failed watch reads without end.
const MAX_WAIT: Duration = Duration::from_secs(10);

/// A shared journal that sends nothing, and gives its records to those who read.
struct Lossy(Vec<Arc<Record>>);

impl Journal for Lossy {
    fn submit(&self, _: Uid, _: Arc<Record>) -> Result<Receipt, LogError> {
        Err(LogError::Closed)
    }

    fn follow(&self, _: Uid, _: u64) -> RecordStream {
        stream::pending().boxed()
    }

    fn read(&self, _: Uid, after: Option<u64>, _: usize) -> Result<Vec<Arc<Record>>, LogError> {
        let later = self.0.iter();
        let later = later.filter(|record| record.revision() > after.unwrap_or(0));
        Ok(later.cloned().collect())
    }

    fn newest(&self, _: Uid) -> Result<u64, LogError> {
        Ok(self.0.last().map_or(0, |last| last.revision()))
    }

    fn is_shared(&self) -> bool {
        true
    }
}

/// The message of a watch after its first one, which begins after revision 2, at a server that has applied some records.
async fn watched(
    applied: &[Arc<Record>],
    journal: Vec<Arc<Record>>,
) -> Result<v1::WatchResponse, Error> {
    let entry = arm();
    let service = testing::server(&Arc::new(Lossy(journal)), &log_with(&entry, applied));
    let after = v1::Revision {
        uid: entry.uid.to_string(),
        number: 2,
    };
    let request = v1::WatchRequest {
        index_name: entry.name,
        after_revision: Some(after),
        ..Default::default()
    };
    let mut watch = service.watch(&Call::default(), request).await.unwrap();
    watch.next().await.unwrap().unwrap();
    let next = timeout(MAX_WAIT, watch.next()).await;
    next.expect("it reads without end").unwrap()
}

#[tokio::test]
async fn the_applied_records_of_the_journal_are_sent() {
    let applied = more(&[], 1, 4);
    let sent = watched(&applied, applied.clone()).await.unwrap();
    assert_eq!(sent.mutations.len(), 2);
}

#[tokio::test]
async fn a_watch_ends_where_the_journal_ends_before_what_its_server_has_applied() {
    let kept = more(&[], 1, 2);
    let applied = more(&kept, 1, 2);
    let refused = watched(&applied, kept).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable);
    let text = refused.to_string();
    assert!(text.contains("the journal ends at revision 2"), "{text}");
}

#[tokio::test]
async fn records_in_the_place_of_applied_ones_are_not_sent() {
    let kept = more(&[], 1, 2);
    let applied = more(&kept, 1, 2);
    let refused = watched(&applied, more(&kept, 2, 2)).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable);
    let text = refused.to_string();
    assert!(text.contains("another one in its place"), "{text}");
}

/// The server has passed the break with a copy of another one.
#[tokio::test]
async fn records_that_do_not_follow_each_other_are_not_sent() {
    let kept = more(&[], 1, 2);
    let applied = more(&kept, 1, 2);
    let mut journal = more(&kept, 2, 2);
    journal[3] = Arc::clone(&applied[3]);
    let reset = watched(&applied, journal).await.unwrap();
    assert_eq!(reset.reset(), v1::ResetReason::WindowPassed);
    assert!(reset.mutations.is_empty());
}
