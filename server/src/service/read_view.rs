//! The index of a call, and the revision that a read sees.

use std::sync::Arc;

use wayfold_proto::v1;

use super::{Call, Error, Service, check::Violations, error_map::registry_error};
use crate::registry::{Hosted, Published};

impl Service {
    /// The index of this name, which must have `uid` unless that is empty.
    pub(super) fn index(&self, name: &str, uid: &str) -> Result<Arc<Hosted>, Error> {
        let hosted = self.registry()?.get(name);
        let hosted = hosted.map_err(|error| registry_error(name, error))?;
        check_uid(&hosted, uid)?;
        Ok(hosted)
    }

    /// Waits until the newest revision is at least `revision`, and returns it for a read. `revision` is the greater of
    /// `min_revision` and `since_revision`: a server that lacks these cannot list later points.
    pub(super) async fn published(
        &self,
        call: &Call,
        hosted: &Hosted,
        revision: u64,
    ) -> Result<Arc<Published>, Error> {
        let published = hosted.published();
        if published.revision >= revision {
            return Ok(published);
        }
        const WAITING: &str = "while waiting for min_revision";
        let reached = hosted.reached(revision);
        let reached = match call.deadline {
            Some(_) => call.bound(WAITING, reached).await?,
            None => tokio::time::timeout(self.limits().min_revision_wait, reached)
                .await
                .map_err(|_| Error::DeadlineExceeded { doing: WAITING })?,
        };
        reached.map_err(|error| registry_error(hosted.name(), error))
    }
}

/// A revision of `hosted`, as answers name it.
pub(super) fn revision(hosted: &Hosted, number: u64) -> v1::Revision {
    v1::Revision {
        uid: hosted.uid_text().into(),
        number,
    }
}

/// The number of the revision that a request names in `field`, 0 for none. A number above 0 needs a uid, and a uid must
/// match the index.
pub(super) fn revision_number(
    hosted: &Hosted,
    field: &str,
    named: Option<&v1::Revision>,
    violations: &mut Violations,
) -> Result<u64, Error> {
    let Some(v1::Revision { uid, number }) = named else {
        return Ok(0);
    };
    check_uid(hosted, uid)?;
    if *number > 0 && uid.is_empty() {
        let text = "a revision needs the uid of the index that it belongs to";
        violations.add(format!("{field}.uid"), "REQUIRED", text);
    }
    Ok(*number)
}

/// Fails if the index has another uid; an empty one matches any.
fn check_uid(hosted: &Hosted, uid: &str) -> Result<(), Error> {
    if uid.is_empty() || uid == hosted.uid_text() {
        return Ok(());
    }
    Err(Error::UidMismatch {
        index: hosted.name().into(),
        requested: uid.into(),
        found: hosted.uid_text().into(),
    })
}
