//! Settings: where they come from, and what the command line answers by itself.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod command_line;
mod layers;
mod repair;
#[path = "../log/tables.rs"]
mod tables;
