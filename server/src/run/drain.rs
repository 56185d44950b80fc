//! The end of a server: accepted calls finish, and what is left is cut.

use std::{pin::pin, time::Duration};

use tokio::time::{Instant, interval, sleep_until, timeout};
use tokio_util::{sync::CancellationToken, task::TaskTracker};
use tracing::{info, warn};

use super::ServerError;
use crate::{grpc::GrpcError, zenoh::ZenohFace};

/// A stopping server waits this long for connections without calls to close. A live peer closes at once, after it has
/// read the rest of its last answer. A frozen peer, or one that never spoke, does not close.
const IDLE_WAIT: Duration = Duration::from_secs(5);

/// Aborted connections may take this long to close.
const CUT_WAIT: Duration = Duration::from_secs(1);

/// Finishes the accepted calls for at most the grace time, then cuts the rest. `serving` ends once gRPC has stopped;
/// `under_way` are the calls of gRPC and of the pages.
pub(super) async fn drain(
    serving: impl Future<Output = Result<(), GrpcError>>,
    zenoh: Option<ZenohFace>,
    under_way: &TaskTracker,
    cut: &CancellationToken,
    grace_ms: u64,
) -> Result<(), ServerError> {
    under_way.close();
    let faces: Vec<TaskTracker> = [under_way.clone()]
        .into_iter()
        .chain(zenoh.as_ref().map(ZenohFace::under_way))
        .collect();
    info!(
        calls = in_use(&faces),
        grace_ms, "stopping: finishing accepted calls"
    );
    let grace_end = Instant::now() + Duration::from_millis(grace_ms);
    let zenoh_stopped = async {
        if let Some(face) = zenoh {
            face.stop().await;
        }
    };
    let mut stopped = pin!(async { tokio::join!(serving, zenoh_stopped, under_way.wait()).0 });
    let calls = tokio::select! {
        drained = &mut stopped => {
            info!("every call has ended; closing the indices");
            return drained.map_err(ServerError::from);
        }
        () = idle(&faces) => 0,
        () = sleep_until(grace_end) => in_use(&faces),
    };
    if calls > 0 {
        warn!(calls, grace_ms, "cutting unfinished calls");
    } else {
        info!("cutting idle connections that do not close");
    }
    cut.cancel();
    // A timeout changes nothing: the outcome is reported below.
    let _ = timeout(CUT_WAIT, stopped).await;
    if calls > 0 {
        return Err(ServerError::Cut { calls, grace_ms });
    }
    info!("every call has ended; closing the indices");
    Ok(())
}

/// The number of calls in flight over all faces.
fn in_use(faces: &[TaskTracker]) -> usize {
    faces.iter().map(TaskTracker::len).sum()
}

/// Returns once no call has been in flight for [`IDLE_WAIT`].
async fn idle(faces: &[TaskTracker]) {
    let mut ticks = interval(IDLE_WAIT / 10);
    let mut since = Instant::now();
    loop {
        let now = ticks.tick().await;
        if in_use(faces) > 0 {
            since = now;
        } else if now.saturating_duration_since(since) >= IDLE_WAIT {
            return;
        }
    }
}
