//! The scene of the example `rigid` as a library with a C interface, so that planners in other languages, and other
//! planners, check the same collisions: `librigid_checks.so` beside the programs of the examples.
//!
//!     cargo build --release -p wayfold --example rigid-checks

#[path = "../planning/mod.rs"]
mod planning;

mod abi;
mod scene;
