//! The planners and the scenes of this package on small problems, with a server in this process.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod collision_checks;
mod figures;
mod planning;
mod rigid_checks;
#[path = "../../../client/tests/client/server.rs"]
mod server;
mod shared_roadmap;
mod shared_trees;
