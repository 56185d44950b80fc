//! `OpenSession`: a writer session, and ids reserved for it.

use std::{
    ops::Range,
    sync::Arc,
    time::{Duration, SystemTime},
};

use bytes::Bytes;
use wayfold_proto::{END_OF_IDS, v1};

use super::{
    Call, Error, Limits, Service,
    check::{self, Violations},
    mutation::{IdempotencyKey, Start},
    read_view::revision,
};
use crate::{
    identity::Role,
    log::{Batch, Effects},
    registry::{Hosted, Writer},
};

impl Service {
    /// Opens a writer session. Sessions that are idle for too long end in the same mutation.
    pub async fn open_session(
        &self,
        call: &Call,
        request: v1::OpenSessionRequest,
    ) -> Result<v1::OpenSessionResponse, Error> {
        let hosted = self.index(call, Role::Write, &request.index_name, &request.uid)?;
        if let Some(answer) = self.forward(call, &hosted, &request).await {
            return answer;
        }
        let limits = self.limits();
        let mut violations = Violations::default();
        check::operation_id(&request.operation_id, &mut violations);
        violations.finish()?;
        let mut pace = call.pace("before anything was changed");
        let key =
            IdempotencyKey::of("OpenSession", &request.operation_id, &request, &mut pace).await?;
        let key = key.as_ref();
        loop {
            let writer = match self.begin(call, &hosted, key).await? {
                Start::Remembered(response) => return Ok(response),
                Start::Writing(writer) => writer,
            };
            let session = writer.revision() + 1;
            let mut effects = Effects::new(hosted.space().coordinates());
            let evaluated = ended(&hosted, &writer, limits).and_then(|ended| {
                let count = request.reserve_count;
                let reserved = reserve(&hosted, &writer, &effects, count, limits, &ended)?;
                let response = v1::OpenSessionResponse {
                    session,
                    reserved: Some(block(&reserved)),
                    idle_seconds: limits.max_session_idle_seconds,
                    revision: Some(revision(&hosted, session)),
                };
                effects.set_batch(Some(Arc::new(Batch {
                    session,
                    number: 0,
                    fingerprint: [0; 32],
                    response: Bytes::new(),
                    reserved,
                    ended,
                })));
                Ok((effects, response))
            });
            let committed = self.commit(call, &hosted, writer, key, evaluated);
            if let Some(response) = committed.await? {
                return Ok(response);
            }
        }
    }
}

/// A session without a batch keeps its place for this long. Otherwise one writer could take all places for a week by opening
/// sessions.
const MIN_UNWRITTEN: Duration = Duration::from_secs(600);

/// The sessions that end as another one opens: those that have been idle for too long and, if there are as many as an index may
/// have, the oldest without a batch. An error if there is no place then.
fn ended(hosted: &Hosted, writer: &Writer, limits: &Limits) -> Result<Vec<u64>, Error> {
    let idle = Duration::from_secs(limits.max_session_idle_seconds);
    let sessions = writer.sessions();
    let mut ended = unused_for(hosted, writer, idle);
    let excess = (sessions.len() - ended.len() + 1).saturating_sub(limits.max_sessions);
    if excess > 0 {
        let unwritten = |id: &u64| sessions.get(*id).is_some_and(|it| it.batch == 0);
        let unused = unused_for(hosted, writer, MIN_UNWRITTEN.min(idle)).into_iter();
        let others: Vec<u64> = unused
            .filter(|id| unwritten(id) && ended.binary_search(id).is_err())
            .take(excess)
            .collect();
        ended.extend(others);
    }
    let open = sessions.len() - ended.len();
    let advice = "open one session a process, or wait until idle ones end";
    check::at_most("max_sessions", limits.max_sessions, open + 1, advice)?;
    Ok(ended)
}

/// The sessions without a batch for this time, by id.
fn unused_for(hosted: &Hosted, writer: &Writer, time: Duration) -> Vec<u64> {
    let since = SystemTime::now().checked_sub(time);
    let mut unused = since.map_or_else(Vec::new, |since| writer.sessions().unused_since(since));
    // Another server's clock may have stamped the records, so this server ends no session that it has seen in use.
    unused.retain(|session| !hosted.is_session_used_within(*session, time));
    unused
}

/// The most blocks of reserved ids that an index keeps for all sessions. Two sessions that reserve in turns get a block
/// each time, and each block takes about a hundred bytes of memory.
const MAX_BLOCKS: usize = 1 << 20;

/// Fails if an index may not have as many blocks.
pub(super) fn block_count(count: usize) -> Result<(), Error> {
    let advice = "reserve more ids at a time, or wait until idle sessions end";
    check::at_most("max_blocks", MAX_BLOCKS, count, advice)
}

/// The next `count` ids above all that were used or reserved, and above those that `effects` stores. The blocks of the
/// sessions in `ended` no longer count.
pub(super) fn reserve(
    hosted: &Hosted,
    writer: &Writer,
    effects: &Effects,
    count: u64,
    limits: &Limits,
    ended: &[u64],
) -> Result<Range<u64>, Error> {
    if count == 0 {
        return Ok(0..0);
    }
    if count > limits.max_reserved_ids {
        return Err(Error::LimitExceeded {
            limit: "max_reserved_ids",
            value: limits.max_reserved_ids,
            requested: count,
            advice: "reserve fewer ids at a time",
        });
    }
    block_count(writer.sessions().block_count_without(ended) + 1)?;
    let first = writer.next_id().max(effects.next_id());
    let end = first.checked_add(count).filter(|end| *end <= END_OF_IDS);
    let end = end.ok_or_else(|| Error::IdsExhausted {
        index: hosted.name().into(),
    })?;
    Ok(first..end)
}

/// The contract's form of reserved ids.
pub(super) fn block(ids: &Range<u64>) -> v1::IdBlock {
    v1::IdBlock {
        first_id: ids.start,
        id_count: ids.end - ids.start,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        log::{Block, Journal, MemoryLog, Origin, PointStore, Record, Session, Sessions},
        service::Code,
        testing::{arm, log_with, server},
    };

    /// The index has as many blocks as it may have, and one of them belongs to an idle session.
    #[tokio::test]
    async fn the_block_of_a_session_that_ends_makes_room_for_another() {
        let mut sessions = Sessions::default();
        for (id, used_ms) in [(1, 0), (2, i64::MAX as u64)] {
            let session = Session {
                batch: 0,
                fingerprint: [0; 32],
                response: Bytes::new(),
                used_ms,
            };
            sessions.insert(id, session);
        }
        for end in 1..=MAX_BLOCKS as u64 {
            let session = if end == 1 { 1 } else { 2 };
            sessions.insert_block(end - 1, Block { end, session });
        }
        let log = Arc::new(MemoryLog::new());
        let origin = Origin {
            revision: 2,
            next_id: MAX_BLOCKS as u64,
            ..Origin::START
        };
        let writer = log.restore(arm(), origin, false).unwrap();
        writer.finish(sessions, Vec::new()).unwrap();
        let service = server(&log, &log);
        let open = async || {
            let request = v1::OpenSessionRequest {
                index_name: "arm".into(),
                reserve_count: 1,
                ..Default::default()
            };
            service.open_session(&Call::default(), request).await
        };
        let reserved = open().await.unwrap().reserved.unwrap();
        assert_eq!(reserved.first_id, MAX_BLOCKS as u64);
        let refused = open().await.unwrap_err();
        assert_eq!(refused.code(), Code::ResourceExhausted);
        assert!(refused.to_string().contains("max_blocks"), "{refused}");
    }

    /// The clock of the server that stamped its batch is far behind.
    #[tokio::test]
    async fn a_session_that_this_server_saw_in_use_does_not_end_by_the_clock_of_another() {
        let entry = arm();
        let log = log_with(&entry, &[]);
        let service = server(&log, &log);
        let hosted = service.registry().unwrap().get("arm").unwrap();
        let mut effects = Effects::new(1);
        effects.set_batch(Some(Arc::new(Batch {
            session: 1,
            number: 0,
            fingerprint: [0; 32],
            response: Bytes::new(),
            reserved: 0..0,
            ended: Vec::new(),
        })));
        let record = Record::new(1, Record::NO_PREVIOUS, 0, effects);
        assert!(log.submit(entry.uid, Arc::new(record)).is_ok());
        hosted.reached(1).await.unwrap();
        let request = v1::OpenSessionRequest {
            index_name: "arm".into(),
            ..Default::default()
        };
        let opened = service.open_session(&Call::default(), request).await;
        assert_eq!(opened.unwrap().session, 2);
        let published = hosted.reached(2).await.unwrap();
        assert!(published.view.sessions().get(1).is_some());
    }
}
