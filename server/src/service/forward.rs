//! Mutations of an index are evaluated by its owner: the other servers of a cluster forward them, so that writers at
//! several servers do not refuse each other.
//!
//! Ownership decides nothing: the journal fences every server, and one whose owner does not answer evaluates the mutation
//! itself.

use bytes::Bytes;
use futures_util::future::BoxFuture;
use prost::Message;
use wayfold_proto::v1;

use super::{Call, Error, Service};
use crate::{log::Uid, registry::Hosted};

/// The owners of the indices of a cluster.
pub trait Owners: Send + Sync {
    /// The server that evaluates the mutations of an index; None if this one does.
    fn owner(&self, uid: Uid) -> Option<String>;

    /// The number of live servers that this one hears, itself among them; 0 if it is cut off.
    fn members(&self) -> usize;

    /// A count, from 1 on, of the changes of the live servers and of the connections to the journal. After each of them an
    /// index may have another owner, or the journal may lack records.
    fn changes(&self) -> u64;

    /// Sends a request for the index with `uid`, encoded, to `owner`, in the name of the caller and with the deadline of
    /// `call`. Returns the encoded answer.
    fn forward<'a>(
        &'a self,
        owner: &'a str,
        uid: Uid,
        rpc: &'static str,
        call: &'a Call,
        request: Bytes,
    ) -> BoxFuture<'a, Result<Bytes, NotForwarded>>;
}

/// The reason why an owner has not answered a call.
#[derive(Clone, Debug)]
pub enum NotForwarded {
    /// The call has not reached it.
    Unsent,
    /// The call may have taken effect.
    Unknown {
        /// The problem.
        what: String,
    },
    /// It refused the call.
    Refused {
        /// The reason, in UPPER_SNAKE_CASE.
        reason: String,
        /// The whole answer.
        status: Box<v1::Status>,
    },
}

/// The reasons of refusals that lie with the owner and not with the call. None of them changed anything.
const REASONS_OF_OWNER: [&str; 16] = [
    // Others may have room.
    "MEMORY_FULL",
    "DISK_FULL",
    "STARTING",
    "STOPPING",
    // The owner has not heard of the index, or of its deletion, or its index has stopped.
    "INDEX_NOT_FOUND",
    "UID_MISMATCH",
    "UID_UNKNOWN",
    "NOT_LOADED",
    // It has other identities, or reads them later. This server has accepted the caller.
    "NO_CREDENTIAL",
    "WRONG_CREDENTIAL",
    "IDENTITY_REVOKED",
    "IDENTITY_EXPIRED",
    "ROLE_TOO_LOW",
    "INDEX_NOT_ALLOWED",
    // It counts the calls of other servers too, all of this one together.
    "TOO_MANY_CALLS",
    "TOO_MANY_BYTES",
];

/// The reasons of failures of the owner, after which the outcome is unknown.
const FAILURES_OF_OWNER: [&str; 3] = ["STORAGE_FAILED", "DATA_LOSS", "INTERNAL"];

/// A request that an owner may answer.
pub(super) trait Forwardable: Message {
    type Answer: Message + Default;

    /// Its path.
    const RPC: &'static str;

    /// True if a repetition takes effect once, at whichever server.
    fn takes_effect_once(&self) -> bool;
}

macro_rules! forwardable {
    ($($request:ident, $answer:ident: $path:literal, $once:expr;)*) => {
        $(impl Forwardable for v1::$request {
            type Answer = v1::$answer;

            const RPC: &'static str = concat!("/wayfold.v1.PointService/", $path);

            fn takes_effect_once(&self) -> bool {
                let once: fn(&Self) -> bool = $once;
                once(self)
            }
        })*
    };
}

forwardable! {
    InsertRequest, InsertResponse: "Insert", |it| !it.operation_id.is_empty();
    UpdateRequest, UpdateResponse: "Update", |it| !it.operation_id.is_empty();
    RemoveRequest, RemoveResponse: "Remove", |it| !it.operation_id.is_empty();
    OpenSessionRequest, OpenSessionResponse: "OpenSession", |it| !it.operation_id.is_empty();
    WriteRequest, WriteResponse: "Write", |_| true;
    GetRequest, GetResponse: "Get", |_| true;
}

impl Service {
    /// True if several servers share the indices.
    pub(crate) fn is_shared(&self) -> bool {
        self.inner.owners.get().is_some()
    }

    /// The live servers of the cluster, this one among them; 0 without a cluster, or if this server is cut off from it.
    pub(crate) fn members(&self) -> u64 {
        let owners = self.inner.owners.get();
        owners.map_or(0, |owners| owners.members() as u64)
    }

    /// True if this server owns the index with this uid: it evaluates its mutations, and publishes them.
    pub(crate) fn owns(&self, uid: &str) -> bool {
        let owners = self.inner.owners.get().zip(uid.parse().ok());
        owners.is_none_or(|(owners, uid)| owners.owner(uid).is_none())
    }

    /// The answer of the owner of an index; None if this server has to answer.
    pub(super) async fn forward<R: Forwardable>(
        &self,
        call: &Call,
        hosted: &Hosted,
        request: &R,
    ) -> Option<Result<R::Answer, Error>> {
        let owners = self.inner.owners.get().filter(|_| !call.is_forwarded)?;
        if hosted.contradiction().is_some() {
            // Every server refuses the call with the reason.
            return None;
        }
        let uid = hosted.uid();
        let owner = owners.owner(uid)?;
        let request_bytes = request.encode_to_vec().into();
        let answered = owners.forward(&owner, uid, R::RPC, call, request_bytes);
        let answered = match call
            .bound("while the owner of the index answered", answered)
            .await
        {
            Ok(answered) => answered,
            Err(late) => return Some(Err(late)),
        };
        let what = match answered {
            Ok(answer) => match R::Answer::decode(answer) {
                Ok(answer) => return Some(Ok(answer)),
                Err(error) => format!("the answer of {owner} does not decode: {error}"),
            },
            Err(NotForwarded::Unsent) => return None,
            Err(NotForwarded::Refused { reason, status })
                if FAILURES_OF_OWNER.contains(&reason.as_str()) =>
            {
                status.message
            }
            Err(NotForwarded::Refused { reason, .. })
                if REASONS_OF_OWNER.contains(&reason.as_str()) =>
            {
                return None;
            }
            Err(NotForwarded::Refused { status, .. }) => {
                return Some(Err(Error::Forwarded { status }));
            }
            Err(NotForwarded::Unknown { what }) => what,
        };
        match request.takes_effect_once() {
            true => None,
            false => Some(Err(Error::StorageFailed {
                what: format!(
                    "the owner of index \"{}\", {owner}, has not answered, and the mutation may have taken place; give \
                     mutations an operation_id, so that they can be repeated: {what}",
                    hosted.name()
                ),
            })),
        }
    }

    /// A revision that has every mutation that was acknowledged before the call, as the owner knows it; None if this server
    /// has to find out.
    pub(super) async fn latest_of_owner(
        &self,
        call: &Call,
        hosted: &Hosted,
    ) -> Result<Option<u64>, Error> {
        let request = v1::GetRequest {
            index_name: hosted.name().into(),
            latest: true,
            min_revision: Some(v1::Revision {
                uid: hosted.uid_text().into(),
                number: 0,
            }),
            ..v1::GetRequest::default()
        };
        let answer = self.forward(call, hosted, &request).await.transpose()?;
        Ok(answer.and_then(|answer| Some(answer.revision?.number)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identity::{Denial, IdentificationError, Role};

    /// This server has accepted the caller: the files of identities change at one server after the other, and each server
    /// counts calls for itself.
    #[test]
    fn a_denial_by_the_owner_lies_with_the_owner() {
        let identity = "cell".to_owned();
        let denials = [
            Denial::Unknown(IdentificationError::NoCredential),
            Denial::Unknown(IdentificationError::WrongCredential),
            Denial::Unknown(IdentificationError::Expired),
            Denial::Unknown(IdentificationError::Revoked),
            Denial::Unknown(IdentificationError::TooManyCalls(1)),
            Denial::Role {
                identity: identity.clone(),
                needed: Role::Write,
            },
            Denial::Index {
                identity,
                index: "arm".into(),
            },
        ];
        for why in denials {
            let denied = Error::Denied { why };
            assert!(REASONS_OF_OWNER.contains(&denied.reason()), "{denied}");
        }
    }
}
