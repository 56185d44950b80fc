//! Counts the acknowledged mutations, and those of them that are lost or duplicated.

use std::{
    collections::{HashMap, HashSet},
    fmt,
};

use prost::bytes::Bytes;
use wayfold_tests::{Content, ledger::Entry};

/// The counts of mutations, without order and revisions, which the model checks.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(crate) acknowledged: u64,
    pub(crate) lost: u64,
    pub(crate) duplicated: u64,
    /// Answers of readers that were compared.
    pub(crate) read: u64,
    /// The calls that stored and removed each payload; payloads are unique.
    rows: HashMap<Bytes, Row>,
    ids: HashMap<u64, Bytes>,
    calls: usize,
}

#[derive(Debug)]
struct Row {
    stored_by: usize,
    removed_by: Option<usize>,
}

impl Tally {
    /// Adds an acknowledged call. The calls of one client are added in its order.
    pub(crate) fn note(&mut self, entry: &Entry) {
        self.calls += 1;
        self.acknowledged += 1;
        match entry {
            Entry::Insert(request, response) => {
                for (payload, &id) in request.payloads.iter().zip(&response.ids) {
                    let row = Row {
                        stored_by: self.calls,
                        removed_by: None,
                    };
                    self.rows.insert(payload.clone(), row);
                    self.ids.insert(id, payload.clone());
                }
            }
            Entry::Remove(request, _) => {
                for id in &request.ids {
                    let row = self
                        .ids
                        .remove(id)
                        .and_then(|payload| self.rows.get_mut(&payload));
                    if let Some(row) = row {
                        row.removed_by = Some(self.calls);
                    }
                }
            }
            Entry::Knn(..) | Entry::Query(..) => {}
        }
    }

    /// Compares the tally with the content. A mutation without its effect counts as lost. Removed rows are forgotten.
    pub(crate) fn count(&mut self, content: &Content) {
        let mut found: HashMap<&[u8], u64> = HashMap::new();
        for point in content.points.values() {
            *found.entry(&point.payload).or_default() += 1;
        }
        let (mut lost, mut duplicated) = (HashSet::new(), HashSet::new());
        self.rows.retain(|payload, row| {
            let times = found.get(&payload[..]).copied().unwrap_or_default();
            match row.removed_by {
                None if times == 0 => lost.insert(row.stored_by),
                Some(removed_by) if times > 0 => lost.insert(removed_by),
                _ => false,
            };
            if times > 1 {
                duplicated.insert(row.stored_by);
            }
            row.removed_by.is_none()
        });
        self.lost += lost.len() as u64;
        self.duplicated += duplicated.len() as u64;
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            acknowledged,
            lost,
            duplicated,
            read,
            ..
        } = self;
        write!(
            f,
            "{acknowledged} mutations acknowledged, {lost} lost, {duplicated} duplicated; {read} reads compared"
        )
    }
}
