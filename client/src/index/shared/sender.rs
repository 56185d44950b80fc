//! The task that sends the pending writes, one batch at a time.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, sleep_until};
use wayfold_proto::v1;

use super::{
    core::{Core, Task},
    link::is_transient,
};
use crate::{Code, Error, IndexInfo, net::request::fresh_operation_id};

/// The least time between the beginnings of two batches that no caller waits for. A call costs server and client more
/// than its rows: batches sent back to back cost planners of a maze on two cores a quarter of their speed.
const BATCH_INTERVAL: Duration = Duration::from_millis(4);

/// The most intervals for which a batch of few writes waits for more. If it waits for one, two planners that check poses
/// and store little lose a tenth of their speed to the calls.
const MAX_INTERVALS: u32 = 8;

/// The next thing to send.
enum Next {
    Nothing,
    Session,
    Batch(Box<v1::WriteRequest>),
}

/// Sends until the index is closed or gone.
pub(super) async fn run(core: Arc<Core>) {
    let mut failures = 0;
    // A repeated call gets the same session.
    let mut operation_id = fresh_operation_id();
    loop {
        let index = core.published.lock().0.clone();
        let began = Instant::now();
        let asked = core.link.connection();
        let sent = match next(&core, &index) {
            Next::Nothing => {
                // Nothing is left to send: the feed may have confirmed the batch whose answer was lost.
                failures = 0;
                core.set_sending();
                core.work.notified().await;
                continue;
            }
            Next::Session => {
                let opened = open(&core, &index, &operation_id).await;
                if opened.is_ok() {
                    operation_id = fresh_operation_id();
                }
                match opened {
                    Err(error) if is_final(&error) => {
                        refuse(&core, &index, None, error);
                        Ok(())
                    }
                    opened => opened,
                }
            }
            Next::Batch(request) => match write(&core, &index, &request).await {
                Err(error) if !is_transient(&error) && !core.link.may_lag(&error) => {
                    refuse(&core, &index, Some(request.session), error);
                    Ok(())
                }
                written => written,
            },
        };
        let Err(error) = sent else {
            failures = 0;
            core.set_sending();
            for intervals in 1..=MAX_INTERVALS {
                tokio::select! {
                    () = sleep_until(began + intervals * BATCH_INTERVAL) => {}
                    () = core.urgent.notified() => break,
                }
                let writes = core.pending_writes.lock();
                if writes.is_next_large() || writes.reserve_count() > 0 {
                    break;
                }
            }
            continue;
        };
        if core.link.may_lag(&error) {
            core.link.leave(asked.as_ref());
        }
        failures += 1;
        let pause = core.link.pause(failures, Some(&error));
        core.set_disconnected(Task::Sender, error);
        sleep_until(Instant::now() + pause).await;
    }
}

fn next(core: &Core, index: &IndexInfo) -> Next {
    let mut writes = core.pending_writes.lock();
    let is_over = core.has_ended() || writes.is_closed && writes.resolved == writes.written;
    if writes.refused.is_none() && !is_over {
        let Some(session) = writes.session else {
            return Next::Session;
        };
        let reserve_count = writes.reserve_count();
        // If the index was made again meanwhile, the next look finds no session.
        if core.is_current(index)
            && let Some(mut request) = writes.next(session, reserve_count)
        {
            request.index_name = index.name.clone();
            request.uid = index.uid().to_string();
            return Next::Batch(Box::new(request));
        }
    }
    writes.is_idle = true;
    Next::Nothing
}

async fn open(core: &Core, index: &IndexInfo, operation_id: &str) -> Result<(), Error> {
    // The limits may be lower after a restart of the server, or at another server.
    let limits = core.link.limits().await?;
    let id_block = {
        let mut writes = core.pending_writes.lock();
        writes.set_limits(limits);
        writes.id_block()
    };
    // The server refuses an operation that is repeated with another number of ids.
    let operation_id = format!("{operation_id}/{id_block}");
    let opened = core.link.open_session(index, id_block, &operation_id);
    let opened = opened.await?;
    let mut writes = core.pending_writes.lock();
    if core.is_current(index) {
        writes.open(opened.session, opened.reserved);
        core.session_opened.notify_one();
        core.progress.notify_all();
    }
    Ok(())
}

async fn write(core: &Core, index: &IndexInfo, request: &v1::WriteRequest) -> Result<(), Error> {
    let (reserved, revision) = core.link.write(index, request).await?;
    let answerable = {
        let mut writes = core.pending_writes.lock();
        if writes.session != Some(request.session) || !core.is_current(index) {
            return Ok(());
        }
        writes.reserve(reserved);
        writes.requested_ids = 0;
        let mut points = core.points.write();
        let published = core.published.lock().1;
        let answerable = writes.acknowledge(request.batch, revision, published, &mut points)?;
        core.progress.notify_all();
        answerable
    };
    core.answer(answerable);
    Ok(())
}

/// True if opening a session cannot succeed later. NOT_FOUND and a changed uid are left to the subscriber, which reloads
/// or ends.
fn is_final(error: &Error) -> bool {
    let is_other_index = matches!(
        error.code(),
        Code::NotFound | Code::FailedPrecondition | Code::Aborted
    );
    !is_transient(error) && !is_other_index
}

/// The server refused a batch or a session for good, unless the session is another one by now.
fn refuse(core: &Core, index: &IndexInfo, session: Option<u64>, error: Error) {
    let mut writes = core.pending_writes.lock();
    if writes.session == session && core.is_current(index) {
        core.refuse(&mut writes, error);
    }
}
