//! Scans page by page, for callers without streams: each page is a call, and all of them read one held revision.

use std::{collections::HashMap, sync::Arc, time::Duration};

use parking_lot::Mutex;
use tokio::time::Instant;
use uuid::Uuid;
use wayfold_proto::v1;

use super::{Call, Error, Service, revision_pin::RevisionPin};
use crate::{log::Uid, registry::Hosted};

/// A scan without a page for this time loses its place to another scan. Callers that left must not keep others out.
const IDLE_TIME: Duration = Duration::from_secs(30);

/// The held revisions of the scans that have further pages, by token.
#[derive(Default)]
pub(super) struct HeldScans(Mutex<HashMap<String, HeldScan>>);

struct HeldScan {
    uid: Uid,
    pinned_revision: Arc<RevisionPin>,
    /// The time of its newest page.
    used: Instant,
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
        let mut scan = self.scan(call, request).await?;
        let mut page = scan.part().await?;
        if scan.is_done() {
            held.0.lock().remove(&token);
        } else if token.is_empty() {
            let max = self.limits().max_held_scans;
            page.held_scan = held.hold(scan.hosted().uid(), scan.pinned_revision(), max)?;
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
    fn hold(
        &self,
        uid: Uid,
        pinned_revision: Arc<RevisionPin>,
        max: usize,
    ) -> Result<String, Error> {
        let mut held = self.0.lock();
        held.retain(|_, scan| scan.pinned_revision.get().is_some());
        if held.len() >= max {
            let oldest = held.iter().min_by_key(|(_, scan)| scan.used);
            let oldest = oldest.filter(|(_, scan)| scan.used.elapsed() >= IDLE_TIME);
            let oldest = oldest.map(|(token, _)| token.clone());
            let idle = oldest.ok_or(Error::LimitExceeded {
                limit: "max_held_scans",
                value: max as u64,
                requested: max as u64 + 1,
                advice: "try again when another scan has ended",
            })?;
            held.remove(&idle);
        }
        let token = Uuid::new_v4().to_string();
        let used = Instant::now();
        held.insert(
            token.clone(),
            HeldScan {
                uid,
                pinned_revision,
                used,
            },
        );
        Ok(token)
    }
}
