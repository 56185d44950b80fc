//! The common code of the planners: sampling-based planning on a `wayfold::Index`.
//!
//! Reading order: `source` (the index and the scans that it is compared with), `problem` (the interface of a scene),
//! `rrt`, `rrt_star` and `prm_star` (the planners), `account` (their time), `path` (their result, checked
//! independently), `comparison` (one problem with every source), `example` (the program around it), `report` (the table
//! and the JSON), `drawing` and `panels` (the common parts of all pictures). For several workers: `processes` (starting
//! workers and reading their messages) and `shared_trees` (RRTConCon by several workers together).

pub mod account;
pub mod body;
pub mod comparison;
pub mod drawing;
pub mod error;
pub mod example;
pub mod figures;
pub mod host;
pub mod options;
pub mod panels;
pub mod path;
pub mod pose;
pub mod prm_star;
pub mod problem;
pub mod processes;
pub mod report;
pub mod rrt;
pub mod rrt_star;
pub mod sampling;
pub mod server;
pub mod shared_trees;
pub mod source;
pub mod worker_panels;
