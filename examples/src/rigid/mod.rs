//! A chair in three rooms, and the roadmap that several processes build for it together.
//!
//! Reading order: `milestone` (the stored form of a milestone), `worker` (the planner), `roadmap` (the result of all
//! workers), `processes` (the role of a worker process), `build` (one roadmap from the start to its paths),
//! `until_solved` (a roadmap that stops at its paths), `sources` (one planner with every source of neighbours),
//! `replay` and `audit` (the expected roadmap), `report`, `picture`, `abi` (the scene for other languages).

pub mod abi;
pub mod account;
pub mod audit;
pub mod build;
pub mod milestone;
pub mod options;
pub mod picture;
pub mod processes;
pub mod replay;
pub mod report;
pub mod roadmap;
pub mod scene;
pub mod sources;
pub mod until_solved;
pub mod worker;

mod solid;
