//! The harness of the end-to-end suites (`tests/e2e`, one behaviour a file).
//!
//! All code here calls a real server process over the generated stubs, and compares its answers with brute force.

pub mod brute_force;
mod content;
pub mod echo;
pub mod figures;
pub mod history;
pub mod ledger;
pub mod measuring;
mod model;
pub mod nats;
mod page;
mod process;
mod refusal;
pub mod report;
mod states;
mod stubs;

pub use content::{Content, StoredPoint};
pub use model::Model;
pub use page::page;
pub use process::{Process, ProcessOutput, ServerProcess, Signal};
pub use refusal::Refusal;
pub use states::States;
pub use stubs::{
    INCLUDE_ALL, Stubs, bits, insert_request, k_nearest, knn_request, neighbor_rows, number,
    revision, row_states,
};

/// Compiles the examples of the README.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;

/// Compiles the examples of the page on Rust.
#[cfg(doctest)]
#[doc = include_str!("../../docs/rust.md")]
struct RustPage;
