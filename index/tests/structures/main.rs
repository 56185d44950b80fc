//! The structures, static and dynamic, against brute force.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;
mod conformance;
mod extremes;
mod forest_model;
mod growing;
mod large_k;
mod refusals;
mod searches;
