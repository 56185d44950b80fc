//! Exact nearest-neighbour indices for motion planners: in memory, or shared by planners in many processes.
//!
//! A planner holds an [`Index`] and need not know its form:
//!
//! ```no_run
//! use wayfold::Index;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let space = "R3*SO3:0.15".parse()?;
//! let alone = Index::in_memory(&space)?; // a library
//! # #[cfg(feature = "net")]
//! let shared = Index::shared("http://127.0.0.1:50051", "arm").create(&space).open()?; // a copy, in step with others'
//! // Poses in space: x, y, z, and a quaternion x, y, z, w.
//! let pose = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];
//! let id = alone.insert(pose)?;
//! let nearest = alone.nearest_k(pose, 10)?;
//! # Ok(())
//! # }
//! ```
//!
//! Beneath the forms stands an asynchronous client, for services and for calls whose answer must be the server's:
//!
//! A [`Client`] is a connection, and an [`IndexHandle`] is one index on it. The handle's methods make requests; await a
//! request to send it:
//!
//! | to | request | answer |
//! |---|---|---|
//! | store states | [`insert`](IndexHandle::insert), [`Insert`] | [`Inserted`], an [`Outcome`] a row |
//! | set tags and payloads | [`update`](IndexHandle::update), [`Update`] | [`Updated`] |
//! | remove points | [`remove`](IndexHandle::remove), [`Remove`] | [`Removed`] |
//! | find the k nearest | [`knn`](IndexHandle::knn), [`Knn`] | [`Neighbors`], a [`StateNeighbors`] a state |
//! | find all within a radius | [`query`](IndexHandle::query), [`Query`] | [`Neighbors`] |
//! | keep many searches under way | [`stream_knn`](IndexHandle::stream_knn), [`KnnRequests`] | [`KnnAnswers`] |
//! | read points by id | [`get`](IndexHandle::get), [`Get`] | [`Points`] |
//! | read all points | [`scan`](IndexHandle::scan), [`ScanRequest`] | [`Scan`] |
//! | follow its mutations | [`watch`](IndexHandle::watch), [`WatchRequest`] | [`Watch`], a [`WatchEvent`] a mutation |
//! | back up all of it | [`snapshot`](IndexHandle::snapshot), [`SnapshotRequest`] | [`Snapshot`] |
//! | verify it | [`verify`](IndexHandle::verify), [`Verify`] | [`Verified`] |
//!
//! [`Client::restore`] makes an index of a snapshot. [`Client::server`] describes the server.
//!
//! **States** are values that implement [`State`]: arrays, slices, vectors, your own types, and with the feature
//! `nalgebra` its types.
//!
//! **Searches** have `k` or `k_factor`, and `radius` (a number or a [`ScaledRadius`]) everywhere. The scaled ones depend
//! on the size of the index, as PRM\* and RRT\* need; the index evaluates them. A [`Search`] of an [`Index`] has `tag`
//! and `since` too; the calls of a handle take them as a [`Filter`], and the columns of their answer as an [`Include`].
//! The neighbours of one state have the methods `ids`, `distances`, `nearest` and `iter` in every answer.
//!
//! **Revisions.** Every answer names its [`Revision`]. A handle's reads see at least the last revision that an answer
//! to the handle named: a caller reads its own writes.
//!
//! **Limits.** A request that exceeds the server's [`Limits`], or [`READ_ROWS`], is sent in several calls, in order,
//! and the answers are joined. Each part of a divided mutation is atomic, but not the whole.
//!
//! **Retries.** The client makes a call that finds no server, one that is starting, or a busy one up to five times
//! ([`RetryPolicy`]). Mutations carry an operation id, so that they take effect once.
//!
//! **Errors.** Every call of the client may fail with [`Error::Connection`], [`Error::Handshake`], [`Error::Timeout`],
//! [`Error::Refused`] and [`Error::Protocol`].
//!
//! **Streams** ([`Scan`], [`Watch`], [`Snapshot`], [`KnnAnswers`]) have a method `next`, which returns
//! `Result<Option<_>, Error>`, and `into_stream`.

mod error;
mod index;
mod layout;
#[cfg(feature = "net")]
mod net;
mod search;
mod state;

pub use error::Error;
pub use index::{
    Changes, Index, InsertOptions, InsertedPoint, Search, SearchResult, StoredPoint, StoredPoints,
};
#[cfg(feature = "net")]
pub use index::{
    ConnectionStatus, Meanwhile, MeanwhileAnswers, OpenRemote, OpenShared, UnsentWrite,
    set_interrupt_check,
};
pub use layout::{Coordinate, coordinate_names};
#[cfg(feature = "net")]
pub use net::*;
pub use search::{Radius, ScaledRadius};
pub use state::{FromState, State};

pub use wayfold_index::{
    Factor, Group, Neighbor, ReadRevision, Scaling, Space, SpaceError, StateError, StateProblem,
    Term,
};
