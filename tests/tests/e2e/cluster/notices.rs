//! How servers noticed, by their own logs, that JetStream lost, hid or changed something.

use std::{
    collections::BTreeMap,
    time::{SystemTime, UNIX_EPOCH},
};

const PUBLISHED_AGAIN: &str = "the journal had lost its newest records";
/// A server of NATS says this every five seconds.
const NO_LEADER: &str = "catchup aborted, no leader for stream";
const DAY_SECONDS: u64 = 86_400;
/// The names of notices, and the parts of the log that say them.
const NOTICES: [(&str, &str); 7] = [
    ("copies", crate::healing::HEALED),
    ("published_again", PUBLISHED_AGAIN),
    ("contradictions", "two servers contradict each other"),
    ("stopped", "no further record is applied"),
    (
        "names_lost",
        "NATS has lost an entry of the catalogue; writing it again",
    ),
    (
        "names_taken",
        "another index has a name whose entry NATS had lost",
    ),
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

    /// The same for a server of NATS.
    pub(super) fn read_nats(&mut self, log: &str) {
        let damage = log.matches("[WRN]").count() + log.matches("[ERR]").count();
        *self.counts.entry("nats_warnings").or_default() += damage;
    }

    /// The panics of servers.
    pub(super) fn panics(&self) -> usize {
        self.counts.get("panics").copied().unwrap_or_default()
    }

    /// True if a server has said that the journal lacks or contradicts what it has applied.
    pub(super) fn tell_of_loss(&self) -> bool {
        self.have(["contradictions", "stopped"])
    }

    /// True if a server has said that the list of the indices in NATS lacks or contradicts what it knows.
    pub(super) fn tell_of_lost_names(&self) -> bool {
        self.have(["names_lost", "names_taken"])
    }

    /// True if there is one of these notices.
    fn have(&self, names: [&str; 2]) -> bool {
        let notices = names.map(|name| self.counts.get(name));
        notices.iter().flatten().any(|count| **count > 0)
    }

    pub(super) fn counts(&self) -> &BTreeMap<&'static str, usize> {
        &self.counts
    }
}

/// True if a server of NATS says again and again after this time that a stream has no leader from which to take what its copy
/// lacks.
pub(super) fn lacks_leader(log: &str, since: SystemTime) -> bool {
    let since = since.duration_since(UNIX_EPOCH).unwrap().as_secs() % DAY_SECONDS;
    let is_new = |line: &&str| {
        let at = second_of_day(line).expect("a line with its time");
        // A run of NATS takes less than half a day.
        (1..DAY_SECONDS / 2).contains(&((at + DAY_SECONDS - since) % DAY_SECONDS))
    };
    let lines = log.lines().filter(|line| line.contains(NO_LEADER));
    lines.filter(is_new).count() >= 5
}

/// The second of the day in a line of NATS: `[process] year/month/day hour:minute:second.fraction [level] text`.
fn second_of_day(line: &str) -> Option<u64> {
    let time = line.split(' ').nth(2)?.split('.').next()?;
    let part = |part: &str| part.parse::<u64>().ok();
    time.split(':')
        .try_fold(0, |seconds, next| Some(seconds * 60 + part(next)?))
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

#[test]
fn a_stream_lacks_its_leader_if_nats_says_so_after_the_last_acknowledgement() {
    let line = |time: &str, text: &str| format!("[7] 2026/11/27 {time}.123456 {text}\n");
    let lost = |minute: &str| {
        let says = |second| {
            line(
                &format!("{minute}:{second:02}"),
                &format!("[WRN] {NO_LEADER} x"),
            )
        };
        (0..5).map(|at| says(5 * at)).collect::<String>()
    };
    let at = |seconds| UNIX_EPOCH + std::time::Duration::from_secs(20_000 * DAY_SECONDS + seconds);
    let led = line("23:58:40", "[INF] JetStream cluster new stream leader");
    let old = format!("{}{led}", lost("23:58"));
    assert!(lacks_leader(&old, at(DAY_SECONDS - 130)));
    assert!(!lacks_leader(&old, at(DAY_SECONDS - 70)));
    assert!(lacks_leader(&(old + &lost("00:00")), at(DAY_SECONDS - 70)));
}
