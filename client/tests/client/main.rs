//! The client against a real server in this process, and against a fake one that fails as a script says.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod backup;
mod dividing;
mod examples;
mod failover;
mod fake;
mod index;
mod lagging;
mod requests;
mod retrying;
mod revisions;
mod scaling;
mod script;
mod server;
mod streaming;
mod typed_states;
mod watching;
