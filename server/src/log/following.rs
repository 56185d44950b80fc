//! The records of one index of an engine as a stream: first those that it has, then each new one.

use std::sync::Arc;

use futures_util::{FutureExt, StreamExt, stream};
use tokio::sync::watch;

use super::{LogError, Record, RecordStream};

/// Announces to `newest` that the records up to this revision may be read, unless that is known or none comes any more.
pub(super) fn announce(newest: &watch::Sender<Result<u64, LogError>>, revision: u64) {
    newest.send_if_modified(|newest| {
        let is_newer = newest.as_ref().is_ok_and(|newest| *newest < revision);
        if is_newer {
            *newest = Ok(revision);
        }
        is_newer
    });
}

/// The records after the revision `after`. `newest` is the newest revision that may be read, or the error after which none
/// comes; `failed` ends the stream once there is nothing more to read. `read` gets the revision before the records, and the
/// newest one.
pub(super) fn follow<Records>(
    newest: watch::Receiver<Result<u64, LogError>>,
    failed: impl Future<Output = LogError> + Send + 'static,
    after: u64,
    read: impl Fn(u64, u64) -> Records + Send + 'static,
) -> RecordStream
where
    Records: Future<Output = Result<Vec<Arc<Record>>, LogError>> + Send,
{
    let follower = (newest, failed.boxed(), after, read);
    let batches = stream::unfold(Some(follower), |follower| async move {
        let (mut newest, mut failed, after, read) = follower?;
        let seen = {
            let has_news = |newest: &Result<u64, LogError>| match newest {
                Ok(newest) => *newest > after,
                Err(_) => true,
            };
            tokio::select! {
                biased;
                seen = newest.wait_for(has_news) => match seen {
                    Ok(seen) => seen.clone(),
                    Err(_) => Err(LogError::Closed),
                },
                why = &mut failed => Err(why),
            }
        };
        let records = match seen {
            Ok(seen) => read(after, seen).await,
            Err(why) => Err(why),
        };
        let next = match &records {
            Ok(records) => {
                let after = records.last().map_or(after, |last| last.revision());
                Some((newest, failed, after, read))
            }
            Err(_) => None,
        };
        Some((records, next))
    });
    batches.boxed()
}
