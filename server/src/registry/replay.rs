//! Replay: builds a hosted index from the log at a restart.

use std::sync::Arc;

use tracing::{error, info};

use super::{Host, Hosted, IndexState, RegistryError, loading::Loader};
use crate::log::{Entry, LogError};

/// Replays the index of an entry. A failed replay marks it as damaged, and one for which there is not enough memory as
/// not loaded.
pub(super) fn replay_or_damaged(host: &Arc<Host>, entry: &Entry) -> IndexState {
    match replay(host, entry) {
        Ok(hosted) => IndexState::Hosted(hosted),
        Err(error) => {
            let error = match error {
                // The catalogue has the index, and this server's store could not create it.
                RegistryError::Deleted if host.log.journal.is_shared() => {
                    let what = "the store of this server lacks the index".into();
                    RegistryError::Log(LogError::CopyUnreadable { what })
                }
                error => error,
            };
            // A stop during the start closes the log.
            if !matches!(error, RegistryError::Log(LogError::Closed)) {
                error!(index = entry.name, uid = %entry.uid, %error, "cannot replay an index");
            }
            IndexState::Damaged(entry.uid, error)
        }
    }
}

/// Builds an index from its points and from the operations that the log remembers. The log of a single server
/// does not remember a call that changed nothing: the server evaluates its retry as a new call.
fn replay(host: &Arc<Host>, entry: &Entry) -> Result<Arc<Hosted>, RegistryError> {
    let mut loader = Loader::new(host, entry);
    let view = host
        .log
        .points
        .load(entry.uid, &mut |point| loader.push(point))?;
    let revision = view.revision();
    let points = loader.len;
    let loaded = loader.finish(revision)?;
    let operations = host.log.points.operations(entry.uid)?;
    info!(
        index = entry.name,
        uid = %entry.uid,
        revision,
        points,
        "replayed an index"
    );
    Ok(Hosted::new(host, entry, loaded, view, operations))
}
