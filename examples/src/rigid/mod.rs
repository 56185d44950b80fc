//! A chair in three rooms, and the roadmap that several processes build for it together.
//!
//! Reading order: `milestone` (what the index keeps), `nearby` (its candidates), `worker` (the planner), `roadmap` (what all
//! of them made), `processes` (what one that is started does), `build` (one roadmap from the start to its paths), `until_solved`
//! (no further than its paths), `sources` (by one planner, with every source of neighbours), `replay` and `audit` (what a
//! roadmap must be), `report`, `picture`, `abi` (the scene for other languages).

pub mod abi;
pub mod account;
pub mod audit;
pub mod build;
pub mod milestone;
pub mod nearby;
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
