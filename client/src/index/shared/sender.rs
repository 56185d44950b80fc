//! The task that sends the pending writes, one batch at a time.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, sleep_until};
use wayfold_proto::v1;

use super::{
    core::{Core, ID_BLOCK},
    link::is_transient,
};
use crate::{Error, IndexHandle};

/// The next thing to send.
enum Next {
    Nothing,
    Session(IndexHandle),
    Batch(IndexHandle, Box<v1::WriteRequest>),
}

/// Sends until the index is closed or gone.
pub(super) async fn run(core: Arc<Core>) {
    let mut failures = 0;
    loop {
        let next = next(&core);
        let is_opening = matches!(next, Next::Session(_));
        let sent = match next {
            Next::Nothing => {
                core.work.notified().await;
                continue;
            }
            Next::Session(index) => open(&core, &index).await,
            Next::Batch(index, request) => write(&core, &index, *request).await,
        };
        match sent {
            Ok(()) => failures = 0,
            // The follower reads an index that was made again, or ends if there is none.
            Err(error) if is_transient(&error) || is_opening => {
                failures += 1;
                let asked = match &error {
                    Error::Refused(refusal) => refusal.retry_after,
                    _ => None,
                };
                let pause = core
                    .link
                    .pause(failures)
                    .max(asked.unwrap_or(Duration::ZERO));
                core.disconnected(error);
                sleep_until(Instant::now() + pause).await;
            }
            Err(error) => core.refuse(error),
        }
    }
}

fn next(core: &Core) -> Next {
    let mut writer = core.writer.lock();
    if writer.refused.is_none() && !core.has_ended() {
        let index = || core.published.lock().0.clone();
        let Some(session) = writer.session else {
            return Next::Session(index());
        };
        let reserve_count = Core::wanted_ids(&writer);
        if let Some(mut request) = writer.next(reserve_count > 0) {
            let index = index();
            request.index_name = index.name().to_owned();
            request.uid = index.uid().to_owned();
            request.session = session;
            request.reserve_count = reserve_count;
            return Next::Batch(index, Box::new(request));
        }
    }
    writer.is_idle = true;
    Next::Nothing
}

async fn open(core: &Core, index: &IndexHandle) -> Result<(), Error> {
    let opened = core.link.open_session(index, ID_BLOCK).await?;
    let mut writer = core.writer.lock();
    writer.open(opened.session, opened.reserved);
    core.progress.notify_all();
    Ok(())
}

async fn write(core: &Core, index: &IndexHandle, request: v1::WriteRequest) -> Result<(), Error> {
    let (session, batch) = (request.session, request.batch);
    let (reserved, revision) = core.link.write(index, request).await?;
    let mut writer = core.writer.lock();
    // The index may have been re-made meanwhile.
    if writer.session == Some(session) {
        writer.reserve(reserved);
        let mut points = core.points.write();
        let published = core.published.lock().1;
        writer.acknowledge(batch, revision, published, &mut points)?;
    }
    core.progress.notify_all();
    Ok(())
}
