//! The resources that indices take, for the metrics of an operator.

use super::Registry;
use crate::log::StoreUsage;

/// A part of the memory or the disk of a server, and its bytes.
pub(crate) type UsagePart = (&'static str, u64);

impl Registry {
    /// About the memory of all indices and of the store, and the disk of the data directory, by part. Blocks.
    pub(crate) fn usage(&self) -> (Vec<UsagePart>, Vec<UsagePart>) {
        let StoreUsage {
            memory,
            journal,
            tables,
            other,
        } = self.host.log.points.usage();
        let (mut trees, mut records, mut operations, mut payload_sizes) = (0, 0, 0, 0);
        for hosted in self.hosted() {
            trees += hosted.published().snapshot.memory_bytes() as u64;
            records += hosted.recent.lock().bytes();
            operations += hosted.operations.lock().bytes();
            payload_sizes += hosted.payload_sizes.lock().memory_bytes();
        }
        let memory = vec![
            ("trees", trees),
            ("recent_records", records),
            ("operations", operations),
            ("payload_sizes", payload_sizes),
            ("store", memory),
        ];
        let disk = vec![("journal", journal), ("tables", tables), ("other", other)];
        (memory, disk)
    }
}
