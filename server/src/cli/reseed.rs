//! `wayfold-server reseed`: starts a new generation of an index of a cluster from the points of this server.

use std::{error::Error, process::ExitCode, sync::Arc};

use tokio::runtime;

use super::{FAILURE_STATUS, USAGE_STATUS, fail, print};
use crate::{
    config::Config,
    log::{FjallLog, Uid, connect_nats},
    registry::{Seed, reseed},
};

/// Starts a new generation of the index of this name, with this uid if it is given.
pub(super) fn run(config: &Config, name: &str, uid: Option<&str>) -> ExitCode {
    let uid = uid.map(str::parse::<Uid>).transpose();
    let usage = |error: &str| fail(&*Box::<dyn Error>::from(error), USAGE_STATUS);
    let Ok(uid) = uid else {
        return usage("--uid is no uid");
    };
    let Some(options) = config.cluster.options() else {
        return usage(
            "only an index of a cluster has generations: set cluster.nats as the server has it",
        );
    };
    let Some(directory) = config.data.directory() else {
        return usage("there are no points in memory: name a data directory with --data");
    };
    let reseeded = || -> Result<_, Box<dyn Error>> {
        let runtime = runtime::Builder::new_multi_thread().enable_all().build()?;
        let _entered = runtime.enter();
        let local = Arc::new(FjallLog::open_existing(directory, config.data.durability)?);
        let (log, _) = connect_nats(&options, Arc::clone(&local))?;
        Ok(reseed(&log, &*local, Seed { name, uid })?)
    };
    match reseeded() {
        Ok(it) => {
            let left_out = match &it.left_out {
                Ok(0) => String::new(),
                Ok(count) => {
                    format!("left out: {count} later revisions, which this server did not have\n")
                }
                Err(error) => format!(
                    "left out: what the journal has after revision {}; it cannot be read, so its revisions were not \
                     counted: {error}\n",
                    it.revision
                ),
            };
            let text = format!(
                "index {name} goes on as {} from revision {} with {} points; it was {}\n{left_out}\
                 next: start this server; the others take copies of it\n",
                it.new, it.revision, it.points, it.old
            );
            print(&text, 0)
        }
        Err(error) => fail(&*error, FAILURE_STATUS),
    }
}
