//! The failures of the registry and of the log as the errors of a call.

use super::Error;
use crate::{log::LogError, registry::RegistryError};

/// The error of a call for a failure of the registry.
pub(super) fn registry_error(index: &str, error: RegistryError) -> Error {
    let what = format!("index \"{index}\": {error}");
    match error {
        RegistryError::Deleted => Error::IndexNotFound { name: index.into() },
        RegistryError::Log(error) => log_error(index, error),
        RegistryError::NoRoom(full) => Error::Full { full },
        RegistryError::NotLoaded {
            points,
            needed,
            full,
        } => Error::NotLoaded {
            index: index.into(),
            points,
            needed,
            full,
        },
        RegistryError::Exists { .. }
        | RegistryError::Taken
        | RegistryError::OtherUid { .. }
        | RegistryError::UnknownUid
        | RegistryError::TooManyIndexes { .. }
        | RegistryError::Follows
        | RegistryError::Stopped => Error::Internal { what },
    }
}

/// The error of a call for a failure of the log.
pub(super) fn log_error(index: &str, error: LogError) -> Error {
    match error {
        LogError::UnknownIndex { .. } => Error::IndexNotFound { name: index.into() },
        error => {
            let what = format!("index \"{index}\": {error}");
            storage_error(what, error)
        }
    }
}

/// The error of a call for a failure that belongs to no single index.
pub(super) fn catalog_error(error: RegistryError) -> Error {
    let what = error.to_string();
    match error {
        RegistryError::Log(error) => storage_error(what, error),
        RegistryError::NoRoom(full) => Error::Full { full },
        _ => Error::Internal { what },
    }
}

fn storage_error(what: String, error: LogError) -> Error {
    match error {
        LogError::Damaged { .. }
        | LogError::Lost { .. }
        | LogError::Unreadable { .. }
        | LogError::Unopened { .. }
        | LogError::Contradicted { .. } => Error::DataLoss { what },
        // Nothing is lost: the other servers of the cluster have it.
        LogError::Trimmed { .. } => Error::StorageFailed {
            what: format!(
                "{what}; the index goes on here from a copy of another server: call again, or call another server"
            ),
        },
        LogError::RecordTooLarge {
            bytes, max_bytes, ..
        } => Error::LimitExceeded {
            limit: "max_record_bytes",
            value: max_bytes as u64,
            requested: bytes as u64,
            advice: "NATS takes at most 1,000 messages for a mutation: split the call, or raise max_payload of NATS",
        },
        LogError::Storage { .. }
        | LogError::StorageStopped
        | LogError::DamagedStore { .. }
        | LogError::Shut { .. }
        | LogError::Unconfirmed { .. }
        // The journal of a cluster gets its records back, or this server a copy of another one.
        | LogError::JournalBehind { .. }
        | LogError::JournalDamaged { .. }
        | LogError::Unreachable { .. }
        | LogError::CopyUnreadable { .. }
        | LogError::Closed => Error::StorageFailed { what },
        LogError::UnknownIndex { .. }
        | LogError::UidTaken { .. }
        | LogError::NameTaken { .. }
        | LogError::Fenced { .. } => Error::Internal { what },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{log::Uid, service::Code};

    #[test]
    fn a_server_that_cannot_follow_its_journal_sends_its_callers_to_another() {
        let uid = Uid::unique();
        let trimmed = LogError::trimmed(uid, 7, 9);
        let behind = LogError::JournalBehind {
            uid,
            head: 7,
            applied: 9,
        };
        let damaged = LogError::damaged_point(uid, 7, "it is cut short").of_copy();
        for error in [trimmed, behind, LogError::replaced(uid, 7), damaged] {
            let error = registry_error("arm", RegistryError::Log(error));
            assert_eq!(error.code(), Code::Unavailable);
            assert!(error.to_string().contains("call another server"), "{error}");
        }
    }
}
