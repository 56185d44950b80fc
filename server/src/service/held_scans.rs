//! Scans page by page, for callers without streams: each page is a call, and all of them read one held revision.

use std::{collections::HashMap, sync::Arc, time::Duration};

use parking_lot::Mutex;
use tokio::time::Instant;
use uuid::Uuid;
use wayfold_proto::v1;

use super::{Call, Error, Service, revision_pin::RevisionPin};
use crate::{admission::ClientPermits, log::Uid, registry::Hosted};

/// A scan without a page for this time loses its place to another scan. Callers that left must not keep others out, nor
/// must one caller with many scans: it loses places to callers with fewer.
const IDLE_TIME: Duration = Duration::from_secs(30);

/// The setting of the scans that are held at a time.
pub(crate) const MAX_HELD_SCANS: &str = "max_held_scans";

/// The held revisions of the scans that have further pages, by token.
#[derive(Default)]
pub(super) struct HeldScans(Mutex<HashMap<String, HeldScan>>);

struct HeldScan {
    caller: ScanCaller,
    uid: Uid,
    pinned_revision: Arc<RevisionPin>,
    /// The time of its newest page.
    used: Instant,
}

/// The caller of a scan: its identity, or its connection on a server without identities.
struct ScanCaller {
    identity: Option<String>,
    connection: Option<Arc<ClientPermits>>,
}

impl ScanCaller {
    fn of(call: &Call) -> Self {
        let identity = call.caller.name().map(str::to_owned);
        let connection = call.permits.clone().filter(|_| identity.is_none());
        Self {
            identity,
            connection,
        }
    }

    /// Equal for scans of one caller.
    fn key(&self) -> (Option<&str>, Option<*const ClientPermits>) {
        let connection = self.connection.as_ref().map(Arc::as_ptr);
        (self.identity.as_deref(), connection)
    }
}

impl Service {
    /// Reads one page of a scan. If there are more, the revision stays held, and `held_scan` names it in the answer.
    /// [`Error::ScanEnded`]: the request names a revision that is not held any more.
    pub async fn scan_page(
        &self,
        call: &Call,
        request: v1::ScanRequest,
    ) -> Result<v1::ScanResponse, Error> {
        let held = &self.inner.held_scans;
        let token = request.held_scan.clone();
        let caller = ScanCaller::of(call);
        let mut scan = self.scan(call, request).await?;
        let mut page = scan.part().await?;
        if scan.done {
            held.0.lock().remove(&token);
        } else if token.is_empty() {
            let max = self.limits().max_held_scans;
            let kept = HeldScan {
                caller,
                uid: scan.hosted.uid(),
                pinned_revision: Arc::clone(&scan.pinned_revision),
                used: Instant::now(),
            };
            page.held_scan = held.hold(kept, max)?;
        } else {
            page.held_scan = token;
        }
        Ok(page)
    }
}

impl HeldScans {
    /// The held revision with this token, of this index.
    pub(super) fn get(&self, token: &str, hosted: &Hosted) -> Result<Arc<RevisionPin>, Error> {
        let mut held = self.0.lock();
        let scan = held.get_mut(token);
        let scan =
            scan.filter(|scan| scan.uid == hosted.uid() && scan.pinned_revision.get().is_some());
        let scan = scan.ok_or_else(|| Error::ScanEnded {
            index: hosted.name().to_owned(),
        })?;
        scan.used = Instant::now();
        Ok(Arc::clone(&scan.pinned_revision))
    }

    /// Releases all revisions.
    pub(super) fn release(&self) {
        self.0.lock().clear();
    }

    /// Keeps a revision held for the scan's further pages, and returns its token.
    fn hold(&self, scan: HeldScan, max: usize) -> Result<String, Error> {
        let mut held = self.0.lock();
        held.retain(|_, scan| scan.pinned_revision.get().is_some());
        if held.len() >= max {
            let place = idle(&held).or_else(|| excess(&held, &scan.caller));
            let place = place.ok_or(Error::LimitExceeded {
                limit: MAX_HELD_SCANS,
                value: max as u64,
                requested: max as u64 + 1,
                advice: "try again when another scan has ended",
            })?;
            held.remove(&place);
        }
        let token = Uuid::new_v4().to_string();
        held.insert(token.clone(), scan);
        Ok(token)
    }
}

/// The token of the scan without a page for the longest time, if that is [`IDLE_TIME`] or more.
fn idle(held: &HashMap<String, HeldScan>) -> Option<String> {
    let (token, scan) = held.iter().min_by_key(|(_, scan)| scan.used)?;
    (scan.used.elapsed() >= IDLE_TIME).then(|| token.clone())
}

/// The token of such a scan of the caller that holds the most. That caller must still hold as many as `asking` then, or
/// the two would take each other's place again and again.
fn excess(held: &HashMap<String, HeldScan>, asking: &ScanCaller) -> Option<String> {
    let mut counts = HashMap::new();
    for scan in held.values() {
        *counts.entry(scan.caller.key()).or_insert(0_usize) += 1;
    }
    let own = counts.get(&asking.key()).copied().unwrap_or_default();
    let (greediest, most) = counts.into_iter().max_by_key(|(_, count)| *count)?;
    let of_greediest = held
        .iter()
        .filter(|(_, scan)| scan.caller.key() == greediest);
    let (token, _) = of_greediest.min_by_key(|(_, scan)| scan.used)?;
    (most > own + 1).then(|| token.clone())
}
