//! The verbs.

mod create;
mod delete;
mod generate;
mod get;
mod health;
mod index_info;
mod insert;
mod neighbors;
mod remove;
mod restore;
mod scan;
mod search;
mod server;
mod snapshot;
mod token;
mod update;
mod verify;
mod watch;

pub(super) use create::{CreateArgs, create};
pub(super) use delete::{DeleteArgs, delete};
pub(super) use generate::{CompletionsArgs, ManArgs, completions, man};
pub(super) use get::{GetArgs, get};
pub(super) use health::health;
pub(super) use index_info::{InfoArgs, info, list};
pub(super) use insert::{InsertArgs, insert};
pub(super) use remove::{RemoveArgs, remove};
pub(super) use restore::{RestoreArgs, restore};
pub(super) use scan::{ScanArgs, scan};
pub(super) use search::{KnnArgs, QueryArgs, knn, query};
pub(super) use server::{durability_words, server};
pub(super) use snapshot::{SnapshotArgs, snapshot};
pub(super) use token::{TokenArgs, token};
pub(super) use update::{UpdateArgs, update};
pub(super) use verify::{VerifyArgs, verify};
pub(super) use watch::{WatchArgs, watch};
