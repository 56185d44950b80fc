//! The asynchronous client: a connection to a server, and its calls.
//!
//! `client` makes the calls on its `connections`, and `handle` is an index; `call` lists the calls with one answer, and
//! `request` has a file for each request. `limits` divides what is too large for one call, `retry` repeats a call that
//! found no server, and `newest` remembers the newest revisions. The other files hold the types of requests and
//! answers.

pub(crate) mod call;
pub(crate) mod client;
mod columns;
pub(crate) mod connections;
mod credentials;
mod handle;
mod include;
mod info;
pub(crate) mod limits;
pub(crate) mod neighbor_spec;
mod neighbors;
mod newest;
pub(crate) mod points;
mod refusal;
pub(crate) mod request;
mod retry;
pub(crate) mod revision;
mod server;
mod snapshot;
mod states;
mod trace;

pub use client::{Client, ClientBuilder};
pub use credentials::Credentials;
pub use handle::IndexHandle;
pub use include::Include;
pub use info::{DamagedIndex, IndexInfo, IndexList};
pub use limits::READ_ROWS;
pub use neighbor_spec::{Filter, NeighborSpec};
pub use neighbors::{Neighbors, StateNeighbors};
pub use points::{Point, Points};
pub use refusal::{FieldViolation, Refusal};
pub use request::{
    Get, Insert, Inserted, Knn, KnnAnswers, KnnRequests, Mutation, Outcome, Query, Remove, Removed,
    Reset, ResetReason, Scan, ScanRequest, Snapshot, SnapshotRequest, Update, Updated, Verified,
    Verify, Watch, WatchEvent, WatchRequest,
};
pub use retry::RetryPolicy;
pub use revision::Revision;
pub use server::{Durability, Limits, ServerInfo};
pub use snapshot::{SnapshotPart, SnapshotReader, SnapshotWriter};
pub use states::States;
pub(crate) use trace::in_same_trace;
pub use trace::in_trace;

pub use tonic::Code;
pub use wayfold_proto::{
    snapshot::{Header as SnapshotHeader, SnapshotError},
    v1::PayloadEncoding,
};
