//! `log`: the mutations after a revision in one answer, for a subscriber that missed some.

use std::sync::atomic::Ordering::Relaxed;

use wayfold_proto::v1;

use super::{Call, Error, Limits, Service, Watch};

impl Service {
    /// The readable mutations after `request.after_revision`, whole, as many as fit an answer. The next request starts
    /// after the last of them; `revision` in the answer is the newest. A mutation larger than an answer fails with
    /// [`Error::LimitExceeded`].
    pub async fn log(
        &self,
        call: &Call,
        request: v1::WatchRequest,
    ) -> Result<v1::WatchResponse, Error> {
        let name = request.index_name.clone();
        let after = request.after_revision.as_ref();
        let after = after.map_or(u64::MAX, |after| after.number);
        let watch = self.watch(call, request).await?;
        let mut watch = watch.with_message_bytes(message_bytes(self.limits()));
        if let Some(held) = &call.held {
            watch = watch.with_read_ahead(held.further());
        }
        let head = next_message(&mut watch).await?;
        let newest = head.revision.as_ref();
        let newest = newest.map_or(0, |newest| newest.number);
        if head.reset.is_some() || after >= newest {
            return Ok(head);
        }
        let mut answer = next_message(&mut watch).await?;
        let cut = answer.mutations.pop_if(|last| last.continued);
        if cut.is_some() && answer.mutations.is_empty() {
            let value = self.limits().max_answer_bytes as u64;
            return Err(Error::LimitExceeded {
                limit: "max_answer_bytes",
                value,
                requested: value + 1,
                advice: "follow the index with Watch, which tells a large mutation in pieces, or start from its points",
            });
        }
        let hosted = self.registry()?.get(&name);
        if let Ok(hosted) = hosted {
            let records = answer.mutations.len() as u64;
            hosted.missed.fetch_add(records, Relaxed);
        }
        Ok(answer)
    }
}

/// The most bytes of a point without its payload.
const POINT_BYTES: usize = 4096;

/// A message exceeds its size by less than one point; this size keeps it within the limit of an answer.
fn message_bytes(limits: &Limits) -> usize {
    let most = limits
        .max_answer_bytes
        .saturating_sub(limits.max_payload_bytes + POINT_BYTES);
    most.max(limits.max_answer_bytes / 2)
}

async fn next_message(watch: &mut Watch) -> Result<v1::WatchResponse, Error> {
    let message = watch.next().await.ok_or_else(|| Error::Internal {
        what: "a watch ended without a message".into(),
    });
    message?
}

#[cfg(test)]
mod tests {
    use std::{
        sync::Arc,
        time::{Duration, Instant},
    };

    use futures_util::poll;
    use tokio::{task::yield_now, time::timeout};

    use super::*;
    use crate::{
        admission::Admission,
        config::Config,
        testing::{arm, engine, server},
    };

    #[tokio::test]
    async fn records_are_read_while_there_is_room_and_count_until_the_answer() {
        let entry = arm();
        let log = engine(&entry, 10);
        let service = server(&log, &log);
        let admission = Admission::new(&Config::default().admission, 1, 0);
        let (other, flow) = (admission.open().hold(), admission.open());
        let after = v1::WatchRequest {
            index_name: "arm".into(),
            after_revision: Some(v1::Revision {
                uid: entry.uid.to_string(),
                number: 0,
            }),
            ..Default::default()
        };
        let mut call = Call {
            held: Some(Arc::new(flow.hold())),
            deadline: Some(Instant::now() + Duration::from_millis(100)),
            ..Call::default()
        };
        other.force_take(admission.bytes().1 as usize + 1);
        let late = service.log(&call, after.clone()).await;
        assert!(
            matches!(late, Err(Error::DeadlineExceeded { .. })),
            "{late:?}"
        );
        other.release_all();
        call.deadline = None;
        let mut answering = Box::pin(service.log(&call, after));
        assert!(poll!(answering.as_mut()).is_pending());
        // The answer is not made before the next poll, and its records are read meanwhile.
        let counted = async {
            while flow.held() < 10 * 30_000 {
                yield_now().await;
            }
        };
        let counted = timeout(Duration::from_secs(10), counted).await;
        counted.expect("the records do not count");
        let answer = answering.await.unwrap();
        assert_eq!(answer.mutations.len(), 10);
        assert_eq!(flow.held(), 0);
        // Its records take no further place among the calls of the flow.
        assert_eq!(flow.under_way(), 1);
    }
}
