//! RRTConCon by several workers on the same two trees, each in an index of one server.
//!
//! Every worker draws its own states, connects both trees to them as the planner of one process does (`rrt`), and
//! inserts the new vertices. The workers share nothing but the indices. A vertex is stored with its parent, so every
//! worker and every reader can read both trees completely, and a worker that dies leaves no vertex without a parent.
//!
//! Reading order: `vertex` (the stored form of a vertex), `store` (the indices), `meeting` (the end of the search),
//! `worker` (the planner), `trees` (the result of all workers), `job` (the job of a process), `solve` (one problem from
//! empty indices to the path), `report`.

pub mod account;
pub mod job;
pub mod meeting;
pub mod report;
pub mod solve;
pub mod store;
pub mod trees;
pub mod vertex;
pub mod worker;
