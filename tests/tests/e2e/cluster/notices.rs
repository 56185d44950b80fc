//! How servers noticed, by their own logs, that JetStream lost, hid or changed something.

use std::collections::BTreeMap;

const PUBLISHED_AGAIN: &str = "the journal had lost its newest records";
/// A server of NATS says this every five seconds.
const NO_LEADER: &str = "catchup aborted, no leader for stream";
/// The names of notices, and the parts of the log that say them.
const NOTICES: [(&str, &str); 5] = [
    ("copies", crate::healing::HEALED),
    ("published_again", PUBLISHED_AGAIN),
    ("contradictions", "two servers contradict each other"),
    ("stopped", "no further record is applied"),
    ("panics", "panicked at"),
];

/// The numbers of notices in the logs.
#[derive(Debug, Default)]
pub(super) struct Notices {
    counts: BTreeMap<&'static str, usize>,
    /// The lines of servers that are of interest.
    pub(super) lines: Vec<String>,
}

impl Notices {
    /// Reads the log of a server that has ended.
    pub(super) fn read(&mut self, server: usize, log: &str) {
        for (name, part) in NOTICES {
            *self.counts.entry(name).or_default() += log.matches(part).count();
        }
        // Records that JetStream had acknowledged and lost.
        let lost = log.lines().filter(|line| line.contains(PUBLISHED_AGAIN));
        *self.counts.entry("records_published_again").or_default() +=
            lost.map(records).sum::<usize>();
        let lines = log.lines().filter(|line| is_of_interest(line));
        self.lines
            .extend(lines.map(|line| format!("server {server}: {line}")));
    }

    /// The same for a server of NATS. Returns true if it says, again and again, that a stream has no leader from which to
    /// take what its copy lacks.
    pub(super) fn read_nats(&mut self, log: &str) -> bool {
        let damage = log.matches("[WRN]").count() + log.matches("[ERR]").count();
        *self.counts.entry("nats_warnings").or_default() += damage;
        log.matches(NO_LEADER).count() >= 5
    }

    /// The panics of servers.
    pub(super) fn panics(&self) -> usize {
        self.counts.get("panics").copied().unwrap_or_default()
    }

    pub(super) fn counts(&self) -> &BTreeMap<&'static str, usize> {
        &self.counts
    }
}

/// The number in a line with `records=number`.
fn records(line: &str) -> usize {
    let number = line.split("records=").nth(1).unwrap_or_default();
    let digits = number.split(|it: char| !it.is_ascii_digit()).next();
    digits.and_then(|it| it.parse().ok()).unwrap_or_default()
}

fn is_of_interest(line: &str) -> bool {
    line.contains("ERROR") || NOTICES.iter().any(|(_, part)| line.contains(part))
}
