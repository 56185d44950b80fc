//! RRTConCon by several workers on the same two trees: two indices of one server, or one with two tags.
//!
//! Every worker draws states of its own, connects both trees to them as the planner of one process does (`rrt`), and inserts
//! what that has made. The indices are all that they share: a vertex is stored with its parent, so that any worker, and who
//! only reads, has the whole of both trees, whoever made them, and a worker that dies leaves no vertex without one.
//!
//! Reading order: `vertex` (what an index keeps), `store` (which indices), `meeting` (how all learn that it is over), `nearest`
//! (the neighbours), `worker` (the planner), `trees` (what all of them made), `job` (what a process is told), `solve` (one
//! problem from empty indices to the path), `report`.

pub mod account;
pub mod job;
pub mod meeting;
pub mod nearest;
pub mod report;
pub mod solve;
pub mod store;
pub mod trees;
pub mod vertex;
pub mod worker;
