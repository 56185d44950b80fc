//! The scene of the program `rigid` as a library with a C interface, so that planners in other languages, and other
//! planners, check the same collisions: `librigid_checks.so`, in the folder `examples/` next to the program.
//!
//!     cargo build --release -p wayfold-examples --example rigid-checks

pub use wayfold_examples::rigid::abi::*;
