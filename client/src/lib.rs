//! The Rust client of Wayfold: shared, exact nearest-neighbour indices for motion planners.
//!
//! ```no_run
//! use wayfold::{Client, NeighborQuery};
//!
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let client = Client::connect("http://127.0.0.1:50051").await?;
//! let roadmap = client.create_index("arm", &"R3*SO3:0.15".parse()?).await?;
//!
//! let poses = [nalgebra::Isometry3::translation(0.1, 0.2, 0.3), nalgebra::Isometry3::translation(0.4, 0.2, 0.3)];
//! let around = NeighborQuery { k: Some(10), ..Default::default() };
//! let inserted = roadmap.insert(&poses).neighbors(around).await?;
//! let nearest = roadmap.knn([[0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0]]).k(10).radius(0.5).await?;
//! for (id, distance) in nearest.row(0).iter() {
//!     println!("{id} at {distance}");
//! }
//! # Ok(())
//! # }
//! ```
//!
//! A [`Client`] is a connection, an [`IndexHandle`] one index on it. The handle's methods make requests, which are
//! awaited to be sent:
//!
//! | to | request | answer |
//! |---|---|---|
//! | store states | [`insert`](IndexHandle::insert), [`Insert`] | [`Inserted`], an [`Outcome`] a row |
//! | set tags and payloads | [`update`](IndexHandle::update), [`Update`] | [`Updated`] |
//! | remove points | [`remove`](IndexHandle::remove), [`Remove`] | [`Removed`] |
//! | find the k nearest | [`knn`](IndexHandle::knn), [`Knn`] | [`Neighbors`], a [`Row`] a state |
//! | find all within a radius | [`query`](IndexHandle::query), [`Query`] | [`Neighbors`] |
//! | keep many searches under way | [`stream_knn`](IndexHandle::stream_knn), [`KnnRequests`] | [`KnnAnswers`] |
//! | read points by id | [`get`](IndexHandle::get), [`Get`] | [`Points`] |
//! | read all points | [`scan`](IndexHandle::scan), [`ScanRequest`] | [`Scan`] |
//! | follow its mutations | [`watch`](IndexHandle::watch), [`WatchRequest`] | [`Watch`], a [`WatchEvent`] a mutation |
//! | back up all of it | [`snapshot`](IndexHandle::snapshot), [`SnapshotRequest`] | [`Snapshot`] |
//! | verify it | [`verify`](IndexHandle::verify), [`Verify`] | [`Verified`] |
//!
//! [`Client::restore`] makes an index of a snapshot.
//!
//! **Replicas.** With the feature `replica`, `Client::replica` gives a copy of an index in this process, which follows the
//! server's and is searched without the network.
//!
//! **States** are whatever implements [`State`]: arrays, slices, vectors, the types of `nalgebra`, your own.
//!
//! **Limits.** What exceeds the bounds of one call ([`REQUEST_BYTES`], [`MUTATION_ROWS`], [`READ_ROWS`], and the bytes
//! of an answer) is sent in several calls, in order, and the answers are joined. A mutation that is divided so is
//! atomic by part, not as a whole.
//!
//! **Retries.** A call that finds no server, or one that is starting, is tried again within its timeout
//! ([`RetryPolicy`]). Mutations carry an operation id, so that they take effect once.
//!
//! **PRM\* and RRT\*.** Numbers and radii of neighbours that depend on the size of the index ([`Scaling`]) are evaluated by
//! the server: [`Knn::k_scaled`], [`Knn::radius_scaled`], [`Query::radius_scaled`], [`NeighborQuery::scaling`].
//!
//! **Read-your-writes.** A handle's reads see at least the last revision that the handle was told of.

mod client;
mod error;
mod handle;
mod info;
mod layout;
mod limits;
mod neighbors;
mod points;
mod read;
mod refusal;
#[cfg(feature = "replica")]
mod replica;
mod request;
mod retry;
mod snapshot;
mod state;
mod states;

pub use client::{Client, ClientBuilder};
pub use error::Error;
pub use handle::IndexHandle;
pub use info::{DamagedIndex, IndexInfo, IndexList};
pub use layout::{Coordinate, coordinate_names};
pub use limits::{MUTATION_ROWS, READ_ROWS, REQUEST_BYTES};
pub use neighbors::{Neighbors, Row};
pub use points::{Point, Points};
pub use read::Include;
pub use refusal::{FieldViolation, Refusal};
#[cfg(feature = "replica")]
pub use replica::{Found, Replica, ReplicaRequest, ReplicaStatus, ReplicaView, Write};
pub use request::{
    Get, Insert, Inserted, Knn, KnnAnswers, KnnRequests, Mutation, NeighborQuery, Outcome, Query,
    Remove, Removed, Reset, ResetReason, Scan, ScanRequest, Snapshot, SnapshotRequest, Update,
    Updated, Verified, Verify, Watch, WatchEvent, WatchRequest,
};
pub use retry::RetryPolicy;
pub use snapshot::{SnapshotPart, SnapshotReader, SnapshotWriter};
pub use state::{FromState, State};
pub use states::States;

pub use tonic::Code;
pub use wayfold_index::{Factor, Filter, Group, Scaling, Space, SpaceError, StateProblem, Term};
#[cfg(feature = "replica")]
pub use wayfold_index::{Neighbor, PointRef, Search};
pub use wayfold_proto::snapshot::{Header as SnapshotHeader, SnapshotError};
