//! Counts the acknowledged mutations, and those of them that are lost or duplicated.

use std::{
    collections::{HashMap, HashSet},
    fmt,
};

use prost::bytes::Bytes;
use wayfold_proto::v1::StepKind;
use wayfold_tests::{Content, ledger::Entry};

/// The counts of mutations, without order and revisions, which the model checks.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    pub(crate) acknowledged: u64,
    /// Those of them that made a revision.
    pub(crate) effective: u64,
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
        if !entry.changed() {
            return;
        }
        self.effective += 1;
        match entry {
            Entry::Insert(request, response) => {
                for (payload, &id) in request.payloads.iter().zip(&response.ids) {
                    self.store(id, payload);
                }
            }
            Entry::Remove(request, _) => {
                for &id in &request.ids {
                    self.remove(id);
                }
            }
            Entry::Write(request, _) => {
                let mut payloads = request.payloads.iter();
                for (kind, &id) in request.kinds().zip(&request.ids) {
                    match kind {
                        StepKind::Put => self.store(id, payloads.next().expect("a payload a put")),
                        StepKind::Remove => self.remove(id),
                        StepKind::SetTag
                        | StepKind::Replace
                        | StepKind::SetPayload
                        | StepKind::Unspecified => {}
                    }
                }
            }
            Entry::Update(..) | Entry::OpenSession(..) | Entry::Knn(..) | Entry::Query(..) => {}
        }
    }

    fn store(&mut self, id: u64, payload: &Bytes) {
        let row = Row {
            stored_by: self.calls,
            removed_by: None,
        };
        self.rows.insert(payload.clone(), row);
        self.ids.insert(id, payload.clone());
    }

    fn remove(&mut self, id: u64) {
        let payload = self.ids.remove(&id);
        if let Some(row) = payload.and_then(|payload| self.rows.get_mut(&payload)) {
            row.removed_by = Some(self.calls);
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
