//! Reads of the journal for watches, in tasks of their own: a client that takes nothing stops the polls of its watch, which
//! would keep a permit, or records that do not count.

use std::sync::Arc;

use tokio::sync::Semaphore;
use tokio_util::task::AbortOnDropHandle;

use crate::{
    admission::HeldBytes,
    log::Record,
    registry::{Hosted, RegistryError},
};

/// The reads at a time: each holds a record of any size.
static READS: Semaphore = Semaphore::const_new(4);

/// Reads the mutations after the revision `after` (see [`Hosted::mutations`]), and counts them in `ahead`. A read begins
/// while there is room, so at most as many records exceed it as reads are under way.
pub(super) async fn read(
    hosted: Arc<Hosted>,
    after: u64,
    max_bytes: usize,
    ahead: Option<Arc<HeldBytes>>,
) -> Result<Vec<Arc<Record>>, RegistryError> {
    let reading = tokio::spawn(async move {
        let mut permit = READS.acquire().await;
        while let Some(ahead) = ahead.as_ref().filter(|ahead| !ahead.has_room(0)) {
            drop(permit);
            ahead.room(0).await;
            permit = READS.acquire().await;
        }
        // It ends even if the watch does: it has the permit.
        let read = tokio::spawn(async move {
            let _permit = permit;
            let read = hosted.mutations(after, max_bytes).await;
            if let (Ok(records), Some(ahead)) = (&read, &ahead) {
                let bytes = records.iter().map(|record| record.effects().bytes());
                ahead.force_take(bytes.sum());
            }
            read
        });
        read.await
    });
    match AbortOnDropHandle::new(reading).await {
        Ok(Ok(read)) => read,
        _ => Err(RegistryError::Stopped),
    }
}
