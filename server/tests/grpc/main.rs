//! The gRPC interface from outside: a server on a port of its own and clients over the network.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod bare;
mod harness;
mod raw;

mod access;
mod connections;
mod deadlines;
mod description;
mod errors;
mod extreme_integers;
#[path = "../extremes/mod.rs"]
mod extremes;
mod health;
#[path = "../extremes/own_index.rs"]
mod own_index;
#[path = "../extremes/quiet.rs"]
mod quiet;
mod receiving;
mod reflection;
mod refusals;
mod shutdown;
mod starting;
mod strangers;
mod stream_knn;
mod streams;
