//! The model of [`crate::model`] with writer sessions: a batch applies step by step to a copy of all points.

use std::collections::BTreeMap;

use wayfold_proto::v1::{self, StepKind};

use crate::{
    model::{Model, Point},
    support::{canonical, revision},
};

/// An index with its writer sessions.
pub(crate) struct SessionModel {
    pub(crate) model: Model,
    /// Every reserved id, with its session.
    pub(crate) owners: BTreeMap<u64, u64>,
    pub(crate) idle_seconds: u64,
}

impl SessionModel {
    pub(crate) fn open(&mut self, reserve_count: u64) -> v1::OpenSessionResponse {
        self.model.revision += 1;
        let session = self.model.revision;
        v1::OpenSessionResponse {
            session,
            reserved: self.reserve(session, reserve_count),
            idle_seconds: self.idle_seconds,
            revision: revision(&self.model.uid, session),
        }
    }

    /// The answer, or the new ids that other sessions reserved. The batch is its session's next one.
    pub(crate) fn write(
        &mut self,
        request: &v1::WriteRequest,
    ) -> Result<v1::WriteResponse, Vec<u64>> {
        let before = &self.model;
        let mut after = before.clone();
        after.revision += 1;
        let states = request.states.clone().unwrap_or_default();
        let rows = canonical(&before.space, &states.coordinates);
        let mut rows = rows.chunks(before.space.coordinates());
        let mut payloads = request.payloads.iter();
        let mut missing_count = 0;
        for (at, (&kind, &id)) in request.kinds.iter().zip(&request.ids).enumerate() {
            let tag = request.tags.get(at).copied().unwrap_or(0);
            let point = after.points.get_mut(&id);
            match (StepKind::try_from(kind).unwrap(), point) {
                (StepKind::Put, _) => {
                    let point = Point {
                        row: rows.next().unwrap().to_vec(),
                        tag,
                        payload: payloads.next().cloned().unwrap_or_default(),
                        stored: after.revision,
                        modified: after.revision,
                    };
                    after.points.insert(id, point);
                }
                (StepKind::Remove, Some(_)) => drop(after.points.remove(&id)),
                (StepKind::SetTag, Some(point)) => point.tag = tag,
                (StepKind::Replace, Some(point)) => {
                    point.row = rows.next().unwrap().to_vec();
                    point.payload = payloads.next().cloned().unwrap_or_default();
                    (point.stored, point.modified) = (after.revision, after.revision);
                }
                (StepKind::Replace, None) => {
                    rows.next().unwrap();
                    payloads.next();
                    missing_count += 1;
                }
                (StepKind::SetPayload, Some(point)) => {
                    point.payload = payloads.next().cloned().unwrap_or_default();
                }
                (StepKind::SetPayload, None) => {
                    payloads.next();
                    missing_count += 1;
                }
                (StepKind::Remove | StepKind::SetTag, None) => missing_count += 1,
                (StepKind::Unspecified, _) => panic!("{request:?}"),
            }
        }
        let is_new = |id: &&u64| !before.points.contains_key(id);
        let owned = |id: &&u64| self.owners.get(id).is_some_and(|it| *it != request.session);
        let refused: Vec<u64> = after
            .points
            .keys()
            .filter(is_new)
            .filter(owned)
            .copied()
            .collect();
        if !refused.is_empty() {
            return Err(refused);
        }
        for (id, point) in &mut after.points {
            let content_before = before.points.get(id).map(|it| (it.tag, &it.payload));
            if point.stored <= before.revision
                && Some((point.tag, &point.payload)) != content_before
            {
                point.modified = after.revision;
            }
        }
        if let Some((last, _)) = after.points.last_key_value() {
            after.next_id = after.next_id.max(last + 1);
        }
        self.model = after;
        Ok(v1::WriteResponse {
            reserved: self.reserve(request.session, request.reserve_count),
            missing_count,
            revision: revision(&self.model.uid, self.model.revision),
        })
    }

    fn reserve(&mut self, session: u64, count: u64) -> Option<v1::IdBlock> {
        if count == 0 {
            return Some(v1::IdBlock::default());
        }
        let first_id = self.model.next_id;
        self.model.next_id += count;
        let ids = first_id..self.model.next_id;
        self.owners.extend(ids.map(|id| (id, session)));
        Some(v1::IdBlock {
            first_id,
            id_count: count,
        })
    }
}
