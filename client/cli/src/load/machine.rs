//! The machine of the callers, and the date, as a report shows them.

use std::{fs, num::NonZero, thread, time::SystemTime};

use time::OffsetDateTime;

/// The machine that runs this process.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Machine {
    /// The processor's name; empty if the system does not tell it.
    pub(super) processor: String,
    /// The processors that this process may use.
    pub(super) processors: usize,
    /// The memory in bytes; `None` if the system does not tell it.
    pub(super) memory_bytes: Option<u64>,
    pub(super) system: String,
}

impl Machine {
    pub(super) fn current() -> Machine {
        let processors = thread::available_parallelism();
        // Other systems than Linux have neither file.
        let cpuinfo = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let meminfo = fs::read_to_string("/proc/meminfo").unwrap_or_default();
        Machine {
            processor: value(&cpuinfo, "model name").unwrap_or_default().to_owned(),
            processors: processors.map_or(1, NonZero::get),
            memory_bytes: value(&meminfo, "MemTotal").and_then(kibibytes),
            system: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        }
    }
}

/// The value of `KEY : VALUE` in one of the lines.
fn value<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let mut pairs = text.lines().filter_map(|line| line.split_once(':'));
    let found = pairs.find(|(name, _)| name.trim() == key);
    found.map(|(_, value)| value.trim())
}

/// The bytes of `16 kB`.
fn kibibytes(text: &str) -> Option<u64> {
    let number: u64 = text.strip_suffix("kB")?.trim().parse().ok()?;
    number.checked_mul(1024)
}

/// A time as `2026-11-24 08:30:00 UTC`.
pub(super) fn utc(time: SystemTime) -> String {
    let time = OffsetDateTime::from(time);
    let (hour, minute, second) = time.to_hms();
    format!("{} {hour:02}:{minute:02}:{second:02} UTC", time.date())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_time_is_written_in_utc() {
        let time = SystemTime::UNIX_EPOCH + Duration::from_secs(951_782_399);
        assert_eq!(utc(time), "2000-02-28 23:59:59 UTC");
    }

    #[test]
    fn the_files_of_the_system_are_read() {
        let text = "processor\t: 0\nmodel name\t: A CPU @ 2 GHz\nMemTotal:   16 kB\n";
        assert_eq!(value(text, "model name"), Some("A CPU @ 2 GHz"));
        assert_eq!(value(text, "MemTotal").and_then(kibibytes), Some(16_384));
        assert_eq!(value(text, "model"), None);
        assert_eq!(kibibytes("16 MB"), None);
    }
}
