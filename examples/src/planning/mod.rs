//! What the planners share: sampling-based planning against one small trait for where the neighbours come from.
//!
//! Reading order: `source` (the trait), `local` and `remote` (its implementations), `problem` (what a scene tells a
//! planner), `rrt`, `rrt_star` and `prm_star` (the planners), `account` (where their time went), `path` (their result,
//! checked anew), `comparison` (one problem with every source), `example` (all of a program that does so), `report` (the
//! table and the JSON), `drawing` and `panels` (what all pictures have in common); of several workers, `processes` (how they
//! are started and heard) and `shared_trees` (RRTConCon by all of them together).

pub mod account;
pub mod comparison;
pub mod crew_panels;
pub mod drawing;
pub mod error;
pub mod example;
pub mod figures;
pub mod local;
pub mod options;
pub mod panels;
pub mod path;
pub mod pose;
pub mod prm_star;
pub mod problem;
pub mod processes;
pub mod remote;
pub mod report;
pub mod rrt;
pub mod rrt_star;
pub mod sampling;
pub mod server;
pub mod shared_trees;
pub mod source;
pub mod under_way;
