//! `wayfold-server reseed`: starts a new generation of an index of a cluster from the points of this server.

use std::{error::Error, process::ExitCode, sync::Arc};

use tokio::runtime;

use super::{FAILURE_STATUS, USAGE_STATUS, fail, print};
use crate::{
    config::Config,
    log::{FjallLog, Uid, connect_nats},
    registry::{LeftOut, Seed, reseed},
};

/// Starts a new generation of the index of this name, with this uid if it is given.
pub(super) fn run(config: &Config, name: &str, uid: Option<&str>) -> ExitCode {
    let uid = uid.map(str::parse::<Uid>).transpose();
    let usage = |error: &str| fail(error, USAGE_STATUS);
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
                Ok(left_out) => report(left_out, it.revision),
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
        Err(error) => fail(error, FAILURE_STATUS),
    }
}

/// The line about the revisions that a new generation from `revision` on leaves out; empty if there are none.
fn report(left_out: &LeftOut, revision: u64) -> String {
    let LeftOut {
        after,
        count,
        is_compared,
    } = *left_out;
    let others = "the directories of the other servers have their points until these servers start";
    let by_time = match is_compared {
        true => "",
        false => ", by the times of the records: this server no longer keeps those to compare",
    };
    match count {
        0 if is_compared => String::new(),
        0 => format!(
            "left out: unknown; the journal ends at revision {after}, and this server no longer keeps the record to compare. If \
             other servers wrote since NATS lost its records, {others}\n"
        ),
        _ if after < revision => format!(
            "left out: {count} revisions after {after}, which other servers wrote in the place of those of this server\
             {by_time}; {others}\n"
        ),
        _ if is_compared => {
            format!("left out: {count} later revisions, which this server did not have\n")
        }
        _ => format!(
            "left out: {count} later revisions, which this server did not have, and perhaps earlier ones of other servers: \
             the journal no longer keeps the record to compare; {others}\n"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_report_names_what_others_wrote() {
        let report = |after, count, is_compared| {
            let left_out = LeftOut {
                after,
                count,
                is_compared,
            };
            super::report(&left_out, 1000)
        };
        assert_eq!(report(900, 0, true), "");
        assert!(report(900, 0, false).contains("left out: unknown"));
        assert!(report(1000, 5, true).contains("left out: 5 later revisions"));
        assert!(report(1000, 5, false).contains("perhaps earlier ones"));
        for is_compared in [false, true] {
            let text = report(900, 30, is_compared);
            assert!(text.contains("left out: 30 revisions after 900"), "{text}");
            assert_eq!(text.contains("by the times"), !is_compared, "{text}");
        }
    }
}
