//! The structures, static and dynamic, against brute force.

mod common;
mod conformance;
mod forest_model;
