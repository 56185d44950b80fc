//! Which index a call means, and which revision of it a read sees.

use std::sync::Arc;

use wayfold_proto::v1;

use super::{Call, Error, Service, check::Violations};
use crate::{
    log::LogError,
    registry::{Hosted, Published, RegistryError},
};

impl Service {
    /// The index of this name, which must have `uid` unless that is empty.
    pub(super) fn index(&self, name: &str, uid: &str) -> Result<Arc<Hosted>, Error> {
        let hosted = self.registry()?.get(name);
        let hosted = hosted.map_err(|error| failed(name, error))?;
        if !uid.is_empty() && uid != hosted.uid_text() {
            return Err(Error::UidMismatch {
                index: name.into(),
                asked: uid.into(),
                found: hosted.uid_text().into(),
            });
        }
        Ok(hosted)
    }

    /// What a read sees: the newest revision, once that is at least `at.min_revision`, and `since_revision`: a server
    /// that has not heard of it yet cannot say what came after it.
    pub(super) async fn published(
        &self,
        call: &Call,
        hosted: &Hosted,
        at: &v1::ReadAt,
        since_revision: u64,
    ) -> Result<Arc<Published>, Error> {
        let revision = at.min_revision.max(since_revision);
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
        reached.map_err(|error| failed(hosted.name(), error))
    }
}

/// A revision above 0 means something only with its uid.
pub(super) fn check_read_at(at: &v1::ReadAt, violations: &mut Violations) {
    if at.min_revision > 0 && at.uid.is_empty() {
        violations.add(
            "at.uid",
            "REQUIRED",
            "min_revision needs the uid of the index it belongs to",
        );
    }
}

/// What a failure of the registry means to a caller.
pub(super) fn failed(index: &str, error: RegistryError) -> Error {
    let what = format!("index \"{index}\": {error}");
    match error {
        RegistryError::Deleted => Error::IndexNotFound { name: index.into() },
        RegistryError::Log(error) => log_failed(index, error),
        RegistryError::Exists { .. }
        | RegistryError::Taken
        | RegistryError::OtherUid { .. }
        | RegistryError::Full { .. }
        | RegistryError::Stopped => Error::Internal { what },
    }
}

/// What a failure of the log means to a caller.
pub(super) fn log_failed(index: &str, error: LogError) -> Error {
    match error {
        LogError::UnknownIndex { .. } => Error::IndexNotFound { name: index.into() },
        error => {
            let what = format!("index \"{index}\": {error}");
            told(what, error)
        }
    }
}

/// As [`log_failed`], of no index in particular.
pub(super) fn unlisted(error: RegistryError) -> Error {
    let what = error.to_string();
    match error {
        RegistryError::Log(error) => told(what, error),
        _ => Error::Internal { what },
    }
}

fn told(what: String, error: LogError) -> Error {
    match error {
        LogError::Damaged { .. }
        | LogError::DamagedPoint { .. }
        | LogError::Lost { .. }
        | LogError::Incomplete { .. }
        | LogError::Unreadable { .. }
        | LogError::Unopened { .. }
        | LogError::Trimmed { .. } => Error::DataLoss { what },
        LogError::Storage { .. } | LogError::Shut { .. } | LogError::Closed => {
            Error::StorageFailed { what }
        }
        LogError::UnknownIndex { .. } | LogError::UidTaken { .. } | LogError::Fenced { .. } => {
            Error::Internal { what }
        }
    }
}
