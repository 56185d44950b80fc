//! A file with a line of JSON for each fault and for each round, with which a run goes on where the last one ended.

use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
};

use serde_json::Value;

/// The records of a run.
pub(super) struct Record {
    path: Option<PathBuf>,
    /// The rounds that ended well.
    done: Vec<u64>,
}

impl Record {
    /// Reads the file of `CLUSTER_RECORD`; without one nothing is kept.
    pub(super) fn open(seed: u64, kinds: &str) -> Self {
        let path = std::env::var_os("CLUSTER_RECORD").map(PathBuf::from);
        let text = path.as_deref().map(read).unwrap_or_default();
        let mut done = Vec::new();
        for line in text.lines() {
            // A line that a killed run has not finished is none.
            let Ok(line) = serde_json::from_str::<Value>(line) else {
                continue;
            };
            let run = (line["seed"].as_u64(), line["kinds"].as_str());
            if let (Some(round), true) = (line["round"].as_u64(), line["ok"] == true) {
                assert_eq!(run, (Some(seed), Some(kinds)), "the file is of another run");
                done.push(round);
            }
        }
        Self { path, done }
    }

    /// True if an earlier run has done this round.
    pub(super) fn has(&self, round: u64) -> bool {
        self.done.contains(&round)
    }

    /// Appends a line, and prints it.
    pub(super) fn append(&self, line: &Value) {
        println!("{line}");
        let Some(path) = &self.path else { return };
        let file = fs::File::options().create(true).append(true).open(path);
        let mut file = file.unwrap();
        writeln!(file, "{line}").unwrap();
    }
}

fn read(path: &Path) -> String {
    match path.exists() {
        true => fs::read_to_string(path).unwrap(),
        false => String::new(),
    }
}
