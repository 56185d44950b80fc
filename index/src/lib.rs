//! Exact, dynamic nearest-neighbour search in the configuration spaces of motion planning: Cartesian products of Rⁿ,
//! S¹ and RP³ with a weighted metric, after Yershova and LaValle.
//!
//! A [`Space`] is the metric: it checks states, brings them into canonical form and measures distances. Four
//! structures answer the same [`Search`] with the same neighbours, in ids and in the bits of the distances:
//!
//! - [`Linear`], brute force, the oracle of the others;
//! - [`Mpnn`], the static kd-tree of Yershova and LaValle as their paper describes it, to compare with;
//! - [`KdTree`], static, built once;
//! - [`Forest`], dynamic, with frozen [`ForestSnapshot`]s for readers while one owner writes.
//!
//! Nothing here does I/O, waits, or starts a thread. Reading order: `space` (the metric), `points` and `neighbor`
//! (points stored and found), `search` (a request) and `linear`; `lanes`, `boxes` and `blocks` (numbers side by side),
//! `kernel` and `quantize` (bounds of many boxes or points at once); `candidates`, `traversal` and `scan_policy` (a
//! search under way); `kdtree`, `mpnn`, `forest`, `overlay` (changes that a snapshot does not have yet); at last
//! `nearest_neighbors` and `scaling` (the calls of a planner).
//!
//! ```
//! use wayfold_index::{Forest, ForestOptions, Points, Search, Space};
//!
//! let space: Space = "R3*SO3:0.15".parse()?;
//! let mut state = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];
//! space.canonicalize(&mut state)?;
//! let mut points = Points::new(space.coordinates());
//! points.push(42, 0, 1, &state);
//! let options = ForestOptions::for_space(&space);
//! let mut forest = Forest::new(space, options);
//! forest.apply(1, &points, &[])?;
//! assert_eq!(forest.search(&state, &Search::nearest_k(10))?.neighbors[0].id, 42);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod aligned;
mod blocks;
mod boxes;
mod candidates;
mod error;
mod forest;
mod kdtree;
mod kernel;
mod lanes;
mod linear;
mod mpnn;
mod nearest_neighbors;
mod neighbor;
mod overlay;
mod points;
mod quantize;
mod scaling;
mod scan_policy;
mod search;
mod space;
mod traversal;

pub use error::{ApplyError, PointsError, SearchError};
pub use forest::{
    Forest, ForestOptions, ForestReport, ForestSnapshot, Merge, Merged, ReplacedLevels,
};
pub use kdtree::{KdTree, TreeReport};
pub use lanes::Kernels;
pub use linear::Linear;
pub use mpnn::Mpnn;
pub use nearest_neighbors::{
    Changes, NearestNeighbors, NewPoint, ReadRevision, ScaledSearch, ScannedPoints,
};
pub use neighbor::Neighbor;
pub use overlay::{EarlierAnswer, Overlay, search_overlaid};
pub use points::{Point, PointRef, Points};
pub use scaling::Scaling;
pub use search::{Answer, Filter, Search};
pub use space::{Factor, Group, Space, SpaceError, StateError, StateProblem, Term};

/// Compiles the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
