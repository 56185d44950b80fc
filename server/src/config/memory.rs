//! The share of the memory that points, calls and merges have.

use serde::Deserialize;

use super::Config;
use crate::watermark::{self, Watermarks};

/// A message has at most this part of the memory limit: two budgets of calls have room for two.
const MESSAGE_PARTS: u64 = 32;

/// `[memory]`
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct MemoryConfig {
    /// The memory that the process may use; 0 to ask the system.
    pub limit_bytes: u64,
    /// The percentage of the limit above which growth is refused.
    pub high_percent: u64,
    /// The percentage of the limit from which it is accepted again.
    pub low_percent: u64,
}

impl Config {
    /// The most bytes that calls hold: those that are set, or an eighth of the memory limit if that is less.
    pub(crate) fn max_call_bytes(&self) -> usize {
        let limit = watermark::memory_limit(self.memory.limit_bytes);
        let eighth = limit.map_or(u64::MAX, |limit| limit / 8);
        let eighth = usize::try_from(eighth).unwrap_or(usize::MAX);
        self.admission.max_bytes.min(eighth)
    }

    /// The most bytes that the three budgets of calls hold: those of administration and all others have room for two
    /// messages, that of unread requests for one.
    fn most_call_bytes(&self) -> usize {
        let message = self.grpc.max_message_bytes;
        let one = message.max(self.zenoh.max_message_bytes);
        let two = one.saturating_mul(2);
        let calls = self.max_call_bytes();
        let budgets = [calls.max(two), (calls / 4).max(two), (calls / 4).max(one)];
        budgets.into_iter().fold(0, usize::saturating_add)
    }

    /// Lowers the limits on messages to what fits into the memory.
    pub(super) fn fit_into_memory(&mut self) {
        let Ok(limit) = watermark::memory_limit(self.memory.limit_bytes) else {
            return;
        };
        let most = usize::try_from(limit / MESSAGE_PARTS).unwrap_or(usize::MAX);
        self.grpc.max_message_bytes = self.grpc.max_message_bytes.min(most);
        self.zenoh.max_message_bytes = self.zenoh.max_message_bytes.min(most);
    }

    /// The watermarks of memory and disk, by these settings.
    pub(crate) fn watermarks(&self) -> Watermarks {
        let MemoryConfig {
            limit_bytes,
            high_percent,
            low_percent,
        } = self.memory;
        let calls = self.most_call_bytes() as u64;
        let disk = self.data.directory();
        Watermarks {
            memory: watermark::memory(limit_bytes, high_percent, low_percent, calls),
            disk: disk.and_then(|directory| watermark::disk(directory, self.disk.min_free_bytes)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1024 * 1024;

    fn with_memory(limit_bytes: u64) -> Config {
        let mut config = Config::default();
        config.memory.limit_bytes = limit_bytes;
        config.fit_into_memory();
        config
    }

    #[test]
    fn calls_hold_at_most_an_eighth_of_the_memory_limit() {
        for (limit, expected) in [(200, 25), (1024, 128), (2048, 256), (65_536, 256)] {
            let config = with_memory(limit * MIB);
            assert_eq!(config.max_call_bytes() as u64, expected * MIB, "{limit}");
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn points_calls_and_merges_fit_into_the_memory_limit() {
        for (limit, high) in [(200, 143), (1024, 768), (2048, 1536), (65_536, 55_705)] {
            let config = with_memory(limit * MIB);
            let memory = config.watermarks().memory.unwrap().now().unwrap();
            assert_eq!(memory.high / MIB, high, "{limit}");
            assert!(memory.low < memory.high, "{limit}");
            let calls = config.most_call_bytes() as u64;
            assert!(memory.high + calls + limit * MIB / 16 <= limit * MIB);
        }
    }
}
