//! The identities of callers, and their rights. Absent rights are no rights.
//!
//! A face finds the [`Caller`] of a call by its token or its client certificate; the service checks the caller's rights
//! once, for every verb. Identities come from a file that is read again when it changes.

mod source;
mod table;

use std::{
    fmt,
    sync::Arc,
    sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed},
    time::SystemTime,
};

use serde::Deserialize;

pub(crate) use source::{Identities, Stamp, follow};
pub use table::TableError;

/// The rights of an identity. Each includes those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Searches, scans, watches, descriptions, snapshots and verifications.
    Read,
    /// Inserts, updates, removals and writer sessions too.
    Write,
    /// Creation, deletion and restoring of indices too.
    Admin,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Role::Read => "read",
            Role::Write => "write",
            Role::Admin => "admin",
        })
    }
}

/// An identity of the file.
#[derive(Debug)]
pub struct Identity {
    name: String,
    role: Role,
    indexes: Vec<Pattern>,
    reads_metrics: bool,
    expires: Option<SystemTime>,
    max_calls: Option<usize>,
    max_indexes: Option<usize>,
    /// The calls under way.
    calls: AtomicUsize,
    /// True once the file has no such identity any more.
    is_revoked: AtomicBool,
}

/// The verified certificate of a client.
#[derive(Clone, Debug)]
pub(crate) struct ClientCertificate {
    /// Its common names, DNS names and URIs.
    pub(crate) names: Vec<String>,
    pub(crate) expires: SystemTime,
}

/// A call of an identity. It counts until it is dropped.
#[derive(Debug)]
pub struct CountedCall {
    identity: Arc<Identity>,
    /// The end of the rights: that of the identity, or of the certificate if that is earlier.
    expires: Option<SystemTime>,
    /// The quota of calls, if this one exceeds it.
    exceeds: Option<usize>,
}

impl CountedCall {
    fn new(identity: &Arc<Identity>, certificate: Option<&ClientCertificate>) -> Self {
        let before = identity.calls.fetch_add(1, Relaxed);
        let ends = [identity.expires, certificate.map(|it| it.expires)];
        Self {
            expires: ends.into_iter().flatten().min(),
            exceeds: identity.max_calls.filter(|most| before >= *most),
            identity: Arc::clone(identity),
        }
    }
}

impl Drop for CountedCall {
    fn drop(&mut self) {
        self.identity.calls.fetch_sub(1, Relaxed);
    }
}

/// The names of indices: exact, or with a `*` for any characters.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Pattern(String);

/// The reason why a caller has no rights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IdentificationError {
    /// The call has neither a token nor a client certificate.
    NoCredential,
    /// No identity has the token or the certificate.
    WrongCredential,
    /// The identity or the client certificate has expired.
    Expired,
    /// The identity was removed or changed after the call had begun.
    Revoked,
    /// The identity has reached its quota of calls under way.
    TooManyCalls(usize),
}

/// The reason why a caller may not make a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Denial {
    /// The caller is not identified.
    Unknown(IdentificationError),
    /// The identity has a lesser role than this one.
    Role {
        /// The identity.
        identity: String,
        /// The role that the call needs.
        needed: Role,
    },
    /// The identity has no rights on the index.
    Index {
        /// The identity.
        identity: String,
        /// The index.
        index: String,
    },
    /// The identity may not read the metrics.
    Metrics {
        /// The identity.
        identity: String,
    },
}

/// The caller of a call.
#[derive(Clone, Debug, Default)]
pub enum Caller {
    /// The server knows no identities: every caller may do everything.
    #[default]
    Anyone,
    /// An identity.
    Known(Arc<CountedCall>),
    /// Not identified.
    Unknown(IdentificationError),
}

impl Caller {
    /// The caller of a call with the credential of `identity`, if there is such an identity.
    fn of(identity: Option<&Arc<Identity>>, certificate: Option<&ClientCertificate>) -> Self {
        match identity {
            Some(identity) => Self::Known(Arc::new(CountedCall::new(identity, certificate))),
            None => Self::Unknown(IdentificationError::WrongCredential),
        }
    }

    fn identity(&self) -> Option<&Identity> {
        match self {
            Caller::Known(calling) => Some(&calling.identity),
            Caller::Anyone | Caller::Unknown(_) => None,
        }
    }

    /// The name of the identity.
    pub fn name(&self) -> Option<&str> {
        Some(&self.identity()?.name)
    }

    /// The most indices that there may be among those that the caller sees, if it has such a quota.
    pub fn max_indexes(&self) -> Option<usize> {
        self.identity()?.max_indexes
    }

    /// True for a call beyond the quota of its identity.
    fn is_excess(&self) -> bool {
        matches!(self, Caller::Known(calling) if calling.exceeds.is_some())
    }

    /// Refuses a caller whose identity is missing, expired or revoked, or has too many calls under way.
    pub fn check(&self) -> Result<(), IdentificationError> {
        let CountedCall {
            identity,
            expires,
            exceeds,
        } = match self {
            Caller::Anyone => return Ok(()),
            Caller::Unknown(stranger) => return Err(*stranger),
            Caller::Known(calling) => &**calling,
        };
        if identity.is_revoked.load(Relaxed) {
            return Err(IdentificationError::Revoked);
        }
        match (expires, exceeds) {
            (Some(expires), _) if SystemTime::now() >= *expires => {
                Err(IdentificationError::Expired)
            }
            (_, Some(most)) => Err(IdentificationError::TooManyCalls(*most)),
            _ => Ok(()),
        }
    }

    /// Refuses a caller without `role` on `index`; without an index, on any.
    pub fn authorize(&self, role: Role, index: Option<&str>) -> Result<(), Denial> {
        self.check().map_err(Denial::Unknown)?;
        let Some(identity) = self.identity() else {
            return Ok(());
        };
        if identity.role < role {
            return Err(Denial::Role {
                identity: identity.name.clone(),
                needed: role,
            });
        }
        match index {
            Some(index) if !self.sees(index) => Err(Denial::Index {
                identity: identity.name.clone(),
                index: index.to_owned(),
            }),
            _ => Ok(()),
        }
    }

    /// Refuses a caller whose identity has neither the right to read the metrics nor the pattern of all indices.
    pub(crate) fn oversee(&self) -> Result<(), Denial> {
        self.check().map_err(Denial::Unknown)?;
        match self.identity() {
            Some(identity)
                if !identity.reads_metrics && identity.indexes.iter().all(|it| it.0 != "*") =>
            {
                Err(Denial::Metrics {
                    identity: identity.name.clone(),
                })
            }
            _ => Ok(()),
        }
    }

    /// True if the caller has rights on an index of this name.
    pub fn sees(&self, index: &str) -> bool {
        match self {
            Caller::Anyone => true,
            Caller::Unknown(_) => false,
            Caller::Known(calling) => calling.identity.indexes.iter().any(|it| it.matches(index)),
        }
    }
}

impl Pattern {
    fn matches(&self, name: &str) -> bool {
        let mut parts = self.0.split('*');
        let first = parts.next().unwrap_or_default();
        let Some(mut rest) = name.strip_prefix(first) else {
            return false;
        };
        let Some(last) = parts.next_back() else {
            return rest.is_empty();
        };
        for part in parts {
            match rest.split_once(part) {
                Some((_, after)) => rest = after,
                None => return false,
            }
        }
        rest.ends_with(last)
    }
}

impl fmt::Display for IdentificationError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            IdentificationError::NoCredential => f.write_str(
                "the call has neither a token (gRPC and HTTP: the header authorization, Zenoh: the attachment \
                 token=TOKEN) nor, over gRPC and HTTP, a client certificate: give it one of an identity of this server",
            ),
            IdentificationError::WrongCredential => {
                f.write_str("no identity of this server has this token or client certificate")
            }
            IdentificationError::Expired => f.write_str("the identity or its client certificate has expired: ask for another token or certificate"),
            IdentificationError::Revoked => f.write_str(
                "the identity was removed or changed: call again with a credential that is valid now",
            ),
            IdentificationError::TooManyCalls(most) => write!(
                f,
                "as many calls of the identity are under way as its max_calls = {most} allows: try again later"
            ),
        }
    }
}

impl fmt::Display for Denial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Denial::Unknown(stranger) => stranger.fmt(f),
            Denial::Role { identity, needed } => {
                write!(
                    f,
                    "the identity \"{identity}\" needs the role {needed} for this call"
                )
            }
            Denial::Index { identity, index } => {
                write!(
                    f,
                    "the identity \"{identity}\" has no rights on the index \"{index}\""
                )
            }
            Denial::Metrics { identity } => write!(
                f,
                "the metrics name all indices: the identity \"{identity}\" needs metrics = true, or the pattern *"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Matches by the definition: tries every length of the first star.
    fn matches_by_definition(pattern: &[u8], name: &[u8]) -> bool {
        match (pattern.split_first(), name.split_first()) {
            (None, None) => true,
            (Some((b'*', rest)), _) => {
                (0..=name.len()).any(|skipped| matches_by_definition(rest, &name[skipped..]))
            }
            (Some((first, rest)), Some((same, others))) if first == same => {
                matches_by_definition(rest, others)
            }
            _ => false,
        }
    }

    proptest! {
        #[test]
        fn patterns_match_as_defined(pattern in "[ab*]{0,6}", name in "[ab]{0,8}") {
            let expected = matches_by_definition(pattern.as_bytes(), name.as_bytes());
            prop_assert_eq!(Pattern(pattern).matches(&name), expected);
        }
    }
}
