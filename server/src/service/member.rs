//! The messages between the members of a cluster that no client sends: an index as a copy, for a member that cannot follow
//! its journal, and the revisions that a member stores. They are on `cluster.listen` alone.
//!
//! A copy is a [`CopyStart`], the parts of a snapshot with their checksums, and the remembered operations. All of it is of
//! one revision.

use bytes::Bytes;
use futures_util::{future::BoxFuture, stream::BoxStream};
use thiserror::Error;
use wayfold_proto::v1;

use crate::log::{Operation, RecordPosition, Uid};

/// The path of the service.
pub(crate) const SERVICE: &str = "wayfold.member.v1.MemberService";

/// The path of the call for a copy: a [`CopyRequest`], answered by a stream of [`CopyPart`].
pub(crate) const COPY: &str = "/wayfold.member.v1.MemberService/Copy";

/// The path of the call for what a member stores: a [`StoredRequest`], answered by a [`StoredResponse`].
pub(crate) const STORED: &str = "/wayfold.member.v1.MemberService/Stored";

/// A record's place in the log of its index.
#[derive(Clone, PartialEq, prost::Message)]
pub struct WirePosition {
    /// Its revision.
    #[prost(uint64, tag = "1")]
    pub revision: u64,
    /// Its digest, of 32 bytes.
    #[prost(bytes = "bytes", tag = "2")]
    pub digest: Bytes,
}

impl From<RecordPosition> for WirePosition {
    fn from(position: RecordPosition) -> Self {
        Self {
            revision: position.revision,
            digest: Bytes::copy_from_slice(&position.digest),
        }
    }
}

impl WirePosition {
    /// The record; None if the digest is none.
    pub(crate) fn position(&self) -> Option<RecordPosition> {
        Some(RecordPosition {
            revision: self.revision,
            digest: self.digest[..].try_into().ok()?,
        })
    }
}

/// Asks for a copy of an index.
#[derive(Clone, PartialEq, prost::Message)]
pub struct CopyRequest {
    /// The uid of the index.
    #[prost(string, tag = "1")]
    pub uid: String,
    /// The newest record that the asking member has applied; absent if it cannot read its points.
    #[prost(message, optional, tag = "2")]
    pub applied: Option<WirePosition>,
    /// The least revision that the copy may have.
    #[prost(uint64, tag = "3")]
    pub min_revision: u64,
}

/// A part of a copy.
#[derive(Clone, PartialEq, prost::Message)]
pub struct CopyPart {
    /// Its kind.
    #[prost(oneof = "CopyKind", tags = "1, 2, 3, 4, 5")]
    pub kind: Option<CopyKind>,
}

/// The kinds of parts.
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum CopyKind {
    /// The first part.
    #[prost(message, tag = "1")]
    Start(CopyStart),
    /// The next part of the points and the sessions, as in a snapshot.
    #[prost(message, tag = "2")]
    Snapshot(v1::SnapshotPart),
    /// The next remembered operations, after the last part of the snapshot.
    #[prost(message, tag = "3")]
    Operations(CopyOperations),
    /// The only part of an answer without a copy: the reason.
    #[prost(string, tag = "4")]
    Refused(String),
    /// The only part of an answer without a copy: the record of this revision differs from that of the asking member.
    #[prost(uint64, tag = "5")]
    Contradicts(u64),
}

/// The beginning of a copy.
#[derive(Clone, PartialEq, prost::Message)]
pub struct CopyStart {
    /// The newest record in the copy.
    #[prost(message, optional, tag = "1")]
    pub position: Option<WirePosition>,
    /// The number of operations that follow.
    #[prost(uint64, tag = "2")]
    pub operations: u64,
    /// True if the giving member still had the newest record of the asking one, and found it equal.
    #[prost(bool, tag = "3")]
    pub is_compared: bool,
}

/// Remembered operations, oldest first.
#[derive(Clone, PartialEq, prost::Message)]
pub struct CopyOperations {
    /// The operations.
    #[prost(message, repeated, tag = "1")]
    pub operations: Vec<CopyOperation>,
}

/// A remembered operation.
#[derive(Clone, PartialEq, prost::Message)]
pub struct CopyOperation {
    /// The id that its caller gave it.
    #[prost(string, tag = "1")]
    pub id: String,
    /// The SHA-256 of its request.
    #[prost(bytes = "bytes", tag = "2")]
    pub fingerprint: Bytes,
    /// The response.
    #[prost(bytes = "bytes", tag = "3")]
    pub response: Bytes,
}

impl From<&Operation> for CopyOperation {
    fn from(operation: &Operation) -> Self {
        Self {
            id: operation.id.clone(),
            fingerprint: Bytes::copy_from_slice(&operation.fingerprint),
            response: operation.response.clone(),
        }
    }
}

impl CopyOperation {
    /// The operation; None if the fingerprint is none.
    pub(super) fn operation(self) -> Option<Operation> {
        Some(Operation {
            fingerprint: self.fingerprint[..].try_into().ok()?,
            // A copy, so that the message can be freed.
            response: Bytes::copy_from_slice(&self.response),
            id: self.id,
        })
    }
}

/// Asks which revisions of some indices a member stores.
#[derive(Clone, PartialEq, prost::Message)]
pub struct StoredRequest {
    /// The uids of the indices.
    #[prost(string, repeated, tag = "1")]
    pub uids: Vec<String>,
    /// For each of them a revision whose digest is asked for, or nothing for all.
    #[prost(uint64, repeated, tag = "2")]
    pub revisions: Vec<u64>,
}

/// The indices that the member serves, in any order.
#[derive(Clone, PartialEq, prost::Message)]
pub struct StoredResponse {
    /// The indices.
    #[prost(message, repeated, tag = "1")]
    pub indexes: Vec<StoredIndex>,
}

/// The revisions that a member stores of an index.
#[derive(Clone, PartialEq, prost::Message)]
pub struct StoredIndex {
    /// Its uid.
    #[prost(string, tag = "1")]
    pub uid: String,
    /// The newest revision that it stores.
    #[prost(uint64, tag = "2")]
    pub revision: u64,
    /// True if the revision survives a loss of power.
    #[prost(bool, tag = "3")]
    pub is_durable: bool,
    /// The oldest revision in its window; absent if that has no record.
    #[prost(uint64, optional, tag = "4")]
    pub oldest: Option<u64>,
    /// The newest record that it has applied.
    #[prost(message, optional, tag = "5")]
    pub applied: Option<WirePosition>,
    /// The record of the revision that was asked for; absent if the member does not keep it.
    #[prost(message, optional, tag = "6")]
    pub requested: Option<WirePosition>,
}

/// The parts of a copy as they arrive.
pub type CopyParts = BoxStream<'static, Result<CopyPart, Unanswered>>;

/// A member has not answered a call of this server.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("{what}")]
pub struct Unanswered {
    /// The problem.
    pub what: String,
}

/// The other members of the cluster, for what members ask each other.
pub trait Peers: Send + Sync {
    /// The other live members, in the order in which to ask them about an index.
    fn peers(&self, uid: Uid) -> Vec<String>;

    /// All other live members.
    fn all(&self) -> Vec<String>;

    /// Waits until the live members are known, a second or so after this server began to hear them.
    fn wait_for_members(&self) -> BoxFuture<'_, ()>;

    /// Asks a member which revisions of some indices it stores.
    fn stored<'a>(
        &'a self,
        member: &'a str,
        request: StoredRequest,
    ) -> BoxFuture<'a, Result<StoredResponse, Unanswered>>;

    /// Asks a member for a copy of an index.
    fn copy<'a>(
        &'a self,
        member: &'a str,
        request: CopyRequest,
    ) -> BoxFuture<'a, Result<CopyParts, Unanswered>>;
}
