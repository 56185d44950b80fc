//! The expected content of the server: one model for each index, with the operations that it answered, and snapshots of
//! some.

use std::collections::{BTreeMap, BTreeSet};

use rand::{RngExt, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::{snapshot::Header, space, v1};

use crate::{
    model::Model,
    random::{Mutation, Reply, Requests},
    support::revision,
    support::snapshots::{SnapshotContent, read},
};

pub(super) struct Expected {
    pub(super) random: ChaCha8Rng,
    pub(super) indexes: BTreeMap<String, ExpectedIndex>,
    pub(super) copies: Vec<TakenSnapshot>,
    /// The number of indices that were restored from copies.
    pub(super) restored: u64,
    /// The uids of all indices that ever existed.
    uids: BTreeSet<String>,
}

/// The expected state of an existing index.
pub(super) struct ExpectedIndex {
    pub(super) model: Model,
    pub(super) operations: Vec<Operation>,
}

/// A mutation with an operation id.
#[derive(Clone)]
pub(super) struct Operation {
    pub(super) mutation: Mutation,
    /// The answer to a retry; None if a retry is evaluated again.
    pub(super) reply: Option<Reply>,
    /// True if it made a revision; a restart forgets the others.
    pub(super) changed: bool,
}

/// A complete snapshot, and the model at its revision.
#[derive(Clone)]
pub(super) struct TakenSnapshot {
    pub(super) parts: Vec<v1::SnapshotPart>,
    pub(super) model: Model,
}

impl Expected {
    pub(super) fn new(random: ChaCha8Rng) -> Self {
        Self {
            random,
            indexes: BTreeMap::new(),
            copies: Vec::new(),
            restored: 0,
            uids: BTreeSet::new(),
        }
    }

    pub(super) fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        *of.choose(&mut self.random).unwrap()
    }

    /// The name of an existing index.
    pub(super) fn present(&mut self) -> Option<String> {
        let names: Vec<&String> = self.indexes.keys().collect();
        names.choose(&mut self.random).map(|name| (*name).clone())
    }

    pub(super) fn requests(&mut self, name: &str) -> Requests {
        let model = &self.indexes[name].model;
        Requests::new(self.random.random(), &model.space, &model.uid).named(name)
    }

    /// Adds an index, whose uid must be new.
    pub(super) fn add(&mut self, name: &str, model: Model) {
        assert!(self.uids.insert(model.uid.clone()), "a uid came again");
        let operations = Vec::new();
        let kept = ExpectedIndex { model, operations };
        assert!(self.indexes.insert(name.into(), kept).is_none());
    }

    /// Forgets the answers that a server forgets when it ends.
    pub(super) fn forget(&mut self) {
        for kept in self.indexes.values_mut() {
            for operation in &mut kept.operations {
                if !operation.changed {
                    operation.reply = None;
                }
            }
        }
    }
}

impl ExpectedIndex {
    /// Applies one of its operations, or recalls the answer to it.
    pub(super) fn apply(&mut self, at: usize) -> Reply {
        let operation = &mut self.operations[at];
        if let Some(reply) = &operation.reply {
            return reply.clone();
        }
        let before = self.model.revision;
        let reply = operation.mutation.apply(&mut self.model);
        operation.changed = self.model.revision > before;
        operation.reply = reply.is_ok().then(|| reply.clone());
        reply
    }
}

/// The answer of `GetIndex` without the memory.
pub(super) fn described(name: &str, model: &Model) -> v1::Index {
    v1::Index {
        name: name.into(),
        space: Some(space::to_message(&model.space)),
        space_text: model.space.to_string(),
        revision: revision(&model.uid, model.revision),
        point_count: model.points.len() as u64,
        coordinate_count: model.space.coordinates() as u32,
        dimension: model.space.dimension() as u32,
        memory_bytes: 0,
        payload_encoding: v1::PayloadEncoding::Edges.into(),
    }
}

/// Asserts that a snapshot holds exactly the content of the model.
pub(super) fn assert_holds(name: &str, parts: &[v1::SnapshotPart], model: &Model) {
    let points = model.points.values().map(|point| {
        let (row, payload) = (point.row.clone(), point.payload.clone());
        (point.tag, point.stored, point.modified, row, payload)
    });
    let header = Header {
        name: name.into(),
        uid: model.uid.clone(),
        space: model.space.clone(),
        revision: model.revision,
        next_id: model.next_id,
        point_count: model.points.len() as u64,
        payload_encoding: v1::PayloadEncoding::Edges,
    };
    let expected = SnapshotContent {
        header,
        ids: model.points.keys().copied().collect(),
        points: points.collect(),
        sessions: v1::SnapshotSessions::default(),
    };
    assert_eq!(read(parts), expected);
}
