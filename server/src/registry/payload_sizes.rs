//! The sizes of the payloads of an index, for its quota.

use std::{collections::HashMap, sync::Arc};

use crate::log::{Effects, Record};

/// The bytes of a slot of the map.
const ENTRY_BYTES: usize = size_of::<(u64, u32)>() + 1;

/// The bytes of each payload as of a revision. Only an index with a quota has them: a point with a payload takes about
/// 24 bytes here.
#[derive(Debug)]
pub(super) struct PayloadSizes {
    sizes: Option<HashMap<u64, u32>>,
    total: u64,
    revision: u64,
}

impl PayloadSizes {
    /// Those of an empty index; with `counted` false they stay 0.
    pub(super) fn new(counted: bool) -> Self {
        Self {
            sizes: counted.then(HashMap::new),
            total: 0,
            revision: 0,
        }
    }

    /// The bytes of all payloads.
    pub(super) fn total(&self) -> u64 {
        self.total
    }

    /// About the bytes that the sizes take.
    pub(super) fn memory_bytes(&self) -> u64 {
        let held = self.sizes.as_ref().map_or(0, HashMap::capacity);
        (held * ENTRY_BYTES) as u64
    }

    /// About the bytes that the sizes of this many payloads take.
    pub(super) fn bytes_of(&self, payloads: usize) -> u64 {
        if self.sizes.is_none() || payloads == 0 {
            return 0;
        }
        // A map fills at most seven eighths of its slots.
        let slots = (payloads * 8 / 7).next_power_of_two();
        (slots * ENTRY_BYTES) as u64
    }

    /// Sets the size of the payload of a point; 0 if it has none.
    pub(super) fn set(&mut self, id: u64, bytes: usize) {
        let Some(sizes) = &mut self.sizes else {
            return;
        };
        let bytes = size(bytes);
        let before = match bytes {
            0 => sizes.remove(&id),
            _ => sizes.insert(id, bytes),
        };
        self.total = self.total - u64::from(before.unwrap_or(0)) + u64::from(bytes);
    }

    /// Notes the next record.
    pub(super) fn apply(&mut self, record: &Record) {
        self.revision = record.revision();
        if self.sizes.is_some() {
            for (id, bytes) in changes(record.effects()) {
                self.set(id, bytes);
            }
        }
    }

    /// The bytes of all payloads after the `pending` records, of which some may be applied, and `effects`.
    pub(super) fn after<'a>(
        &self,
        pending: impl Iterator<Item = &'a Arc<Record>>,
        effects: &Effects,
    ) -> u64 {
        let Some(sizes) = &self.sizes else {
            return 0;
        };
        let unknown = pending.filter(|record| record.revision() > self.revision);
        let unknown = unknown.flat_map(|record| changes(record.effects()));
        let changed: HashMap<u64, usize> = unknown.chain(changes(effects)).collect();
        let before = changed.keys().filter_map(|id| sizes.get(id));
        let before: u64 = before.map(|&bytes| u64::from(bytes)).sum();
        let now: u64 = changed.values().map(|&bytes| u64::from(size(bytes))).sum();
        self.total - before + now
    }
}

/// The points that a mutation changes, and the new sizes of their payloads.
fn changes(effects: &Effects) -> impl Iterator<Item = (u64, usize)> {
    let stored = effects.stored().ids().iter().enumerate();
    let stored = stored.map(|(slot, &id)| (id, effects.payload(slot).len()));
    stored.chain(effects.removed().iter().map(|&id| (id, 0)))
}

/// Payloads have 64 KiB at most.
fn size(bytes: usize) -> u32 {
    u32::try_from(bytes).unwrap_or(u32::MAX)
}
