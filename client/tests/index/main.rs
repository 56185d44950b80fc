//! [`Index`](wayfold::Index) in its forms, against brute force.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod conformance;
mod memory;
mod model;
mod remote;
#[path = "../client/server.rs"]
mod server;
mod shared;
