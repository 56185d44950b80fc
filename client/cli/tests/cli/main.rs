//! The command line as a process, against a real server in this process and against a fake one.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod backup;
mod brute_force;
mod damaged;
mod environment;
mod errors;
#[expect(dead_code, reason = "the suite of the client takes more of it")]
#[path = "../../../tests/client/fake/mod.rs"]
mod fake;
mod files;
mod generate;
mod health;
#[path = "../../../../server/tests/log/journal_end.rs"]
mod journal_end;
mod lasting;
mod load;
mod partial;
mod pipes;
mod poses;
mod process;
mod scan;
mod selection;
#[path = "../../../tests/client/server.rs"]
mod server;
mod verbs;
