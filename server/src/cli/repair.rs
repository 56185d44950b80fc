//! `wayfold-server repair`: rebuilds a damaged store from everything that can be read of it.

use std::{fmt::Write, path::Path, process::ExitCode};

use super::{FAILURE_STATUS, USAGE_STATUS, fail, print};
use crate::{
    config::Config,
    log::{RepairReport, repair},
};

/// Exit status: the store stays damaged. The client uses the same status for a negative answer.
const DAMAGED_STATUS: u8 = FAILURE_STATUS;
/// Exit status: the store cannot be repaired.
const UNREPAIRED_STATUS: u8 = 3;

/// Repairs the store of the configured data directory, or only reports with `dry_run`.
pub(super) fn run(config: &Config, dry_run: bool) -> ExitCode {
    let Some(directory) = config.data.directory() else {
        let error = "there is nothing to repair in memory: name a data directory with --data";
        return fail(error, USAGE_STATUS);
    };
    match repair(directory, dry_run) {
        Ok(report) => {
            let is_damaged = report.damage.is_some() && dry_run || !report.beyond_repair.is_empty();
            let status = if is_damaged { DAMAGED_STATUS } else { 0 };
            print(&text(&report, directory, dry_run), status)
        }
        Err(error) => fail(error, UNREPAIRED_STATUS),
    }
}

fn text(report: &RepairReport, directory: &Path, dry_run: bool) -> String {
    let directory = directory.display();
    let room = format!(
        "a repair needs {} free bytes, and {} are free",
        report.needed_bytes, report.free_bytes
    );
    // Writing to a string never fails.
    let mut beyond = String::new();
    for (name, why) in &report.beyond_repair {
        let _ = writeln!(beyond, "beyond repair: {name} ({why})");
    }
    if !beyond.is_empty() {
        beyond += "a repair cannot bring these back: do what their reasons say, or see \"An index answers \
                   DATA_LOSS\" in docs/operations.md\n";
    }
    let Some(damage) = &report.damage else {
        let found = match beyond.is_empty() {
            true => format!("the store in {directory} is whole: nothing to repair\n"),
            false => {
                format!(
                    "the store in {directory} can be read, and has lost or damaged records\n{beyond}"
                )
            }
        };
        return match dry_run {
            true => format!("{found}{room}\n"),
            false => found,
        };
    };
    let mut text = format!("the store in {directory} is damaged: {damage}\n");
    let (verb, losing) = match report.kept {
        Some(_) => ("kept", "lost"),
        None => ("a repair keeps", "a repair loses"),
    };
    let indices = if report.whole == 1 {
        "index"
    } else {
        "indices"
    };
    let _ = writeln!(text, "{verb}: {} {indices}", report.whole);
    for (name, damage) in &report.lost {
        let _ = writeln!(text, "{losing}: {name} ({damage})");
    }
    text += &beyond;
    let _ = match &report.kept {
        Some(kept) => writeln!(
            text,
            "the store is rebuilt; the damaged one is kept as {}: remove it when you no longer need it\n\
             next: start the server, then delete each lost index and restore it from its snapshot",
            kept.display()
        ),
        None => writeln!(text, "{room}; run it without --dry-run"),
    };
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_report_says_what_a_repair_costs_and_what_it_did() {
        let mut report = RepairReport {
            damage: Some("checksum mismatch".into()),
            whole: 2,
            lost: vec![("arm".into(), "checksum mismatch".into())],
            beyond_repair: Vec::new(),
            needed_bytes: 100,
            free_bytes: 200,
            kept: None,
        };
        let planned = text(&report, Path::new("data"), true);
        for part in [
            "data is damaged: checksum mismatch",
            "a repair keeps: 2 indices",
            "a repair loses: arm (",
            "needs 100 free bytes, and 200 are free",
        ] {
            assert!(planned.contains(part), "{planned}");
        }
        report.kept = Some("data/store.damaged-1".into());
        let done = text(&report, Path::new("data"), false);
        for part in ["kept: 2", "lost: arm", "data/store.damaged-1", "next: "] {
            assert!(done.contains(part), "{done}");
        }
        report.damage = None;
        assert!(text(&report, Path::new("data"), false).contains("is whole"));
    }
}
