//! The simplest index that fulfils the contract: a sorted map, searched from end to end and copied where something must
//! be undone. It shares nothing with the server but the distance of two states.

use std::collections::BTreeMap;

use bytes::Bytes;
use wayfold_index::{Factor, Space};
use wayfold_proto::v1::{
    self, Outcome,
    neighbor_spec::{KForm, RadiusForm},
};

use crate::support::{canonical, revision};

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Point {
    pub(crate) row: Vec<f64>,
    pub(crate) tag: u64,
    pub(crate) payload: Bytes,
    pub(crate) stored: u64,
    pub(crate) modified: u64,
}

#[derive(Clone)]
pub(crate) struct Model {
    pub(crate) space: Space,
    pub(crate) uid: String,
    pub(crate) revision: u64,
    pub(crate) points: BTreeMap<u64, Point>,
    pub(crate) next_id: u64,
}

/// The reason of a refusal, with all ids.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Refused {
    Exist(Vec<u64>),
    Missing(Vec<u64>),
    Changed(Vec<u64>),
}

impl Model {
    pub(crate) fn new(space: Space, uid: String) -> Self {
        Self {
            space,
            uid,
            revision: 0,
            points: BTreeMap::new(),
            next_id: 0,
        }
    }

    pub(crate) fn insert(
        &mut self,
        request: &v1::InsertRequest,
    ) -> Result<v1::InsertResponse, Refused> {
        let mut next = self.clone();
        let rows = canonical(&self.space, &request.states.as_ref().unwrap().coordinates);
        let (mut outcomes, mut ids, mut conflicts) = (Vec::new(), Vec::new(), Vec::new());
        let mut found = Columns::new(
            request
                .neighbor_spec
                .as_ref()
                .and_then(|query| query.include),
        );
        let mut changed = false;
        for (at, row) in rows.chunks(self.space.coordinates()).enumerate() {
            let id = request.ids.get(at).copied().unwrap_or(next.next_id);
            let point = Point {
                row: row.to_vec(),
                tag: request.tags.get(at).copied().unwrap_or(0),
                payload: request.payloads.get(at).cloned().unwrap_or_default(),
                stored: self.revision + 1,
                modified: self.revision + 1,
            };
            if let Some(query) = &request.neighbor_spec {
                let (k, radius) = next.bounds(query.k_form, query.radius_form);
                let mut all = next.within(row, radius, query.filter.as_ref());
                all.retain(|(_, other)| *other != id);
                all.truncate(k);
                found.push(&next, &all);
            }
            let held = next.points.get(&id);
            if held.is_some_and(|held| {
                (&held.row, held.tag, &held.payload) == (&point.row, point.tag, &point.payload)
            }) {
                outcomes.push(Outcome::Unchanged.into());
                ids.push(id);
                continue;
            }
            let replaced = held.is_some();
            if replaced && request.on_conflict != i32::from(v1::OnConflict::Replace) {
                conflicts.push(id);
                continue;
            }
            let in_the_way = next
                .within(row, f64::INFINITY, None)
                .into_iter()
                .find(|(distance, other)| *other != id && *distance < request.min_separation);
            if let Some((_, blocker)) = in_the_way {
                outcomes.push(Outcome::TooClose.into());
                ids.push(blocker);
                continue;
            }
            let outcome = if replaced {
                Outcome::Replaced
            } else {
                Outcome::Inserted
            };
            outcomes.push(outcome.into());
            ids.push(id);
            next.points.insert(id, point);
            next.next_id = next.next_id.max(id + 1);
            changed = true;
        }
        if !conflicts.is_empty() {
            return Err(Refused::Exist(conflicts));
        }
        self.take(next, changed);
        Ok(v1::InsertResponse {
            outcomes,
            ids,
            neighbors: request.neighbor_spec.as_ref().map(|_| found.columns),
            revision: revision(&self.uid, self.revision),
        })
    }

    pub(crate) fn update(
        &mut self,
        request: &v1::UpdateRequest,
    ) -> Result<v1::UpdateResponse, Refused> {
        let mut next = self.clone();
        let (mut missing, mut conflicts) = (Vec::new(), Vec::new());
        let mut updated = 0;
        for (at, &id) in request.ids.iter().enumerate() {
            let Some(point) = next.points.get_mut(&id) else {
                missing.push(id);
                continue;
            };
            if request
                .if_revision
                .as_ref()
                .is_some_and(|revision| point.modified > revision.number)
            {
                conflicts.push(id);
            }
            let before = (point.tag, point.payload.clone());
            for bit in 0..64 {
                let tag = match request.tags.len() {
                    0 => point.tag,
                    1 => request.tags[0],
                    _ => request.tags[at],
                };
                if request.tag_mask.is_none_or(|mask| mask >> bit & 1 == 1) {
                    point.tag = point.tag & !(1 << bit) | tag & (1 << bit);
                }
            }
            if !request.payloads.is_empty() {
                point.payload = request.payloads[at].clone();
            }
            if before != (point.tag, point.payload.clone()) {
                point.modified = self.revision + 1;
                updated += 1;
            }
        }
        if !missing.is_empty() {
            return Err(Refused::Missing(missing));
        }
        if !conflicts.is_empty() {
            return Err(Refused::Changed(conflicts));
        }
        self.take(next, updated > 0);
        Ok(v1::UpdateResponse {
            updated_count: updated,
            unchanged_count: request.ids.len() as u64 - updated,
            revision: revision(&self.uid, self.revision),
        })
    }

    pub(crate) fn remove(&mut self, request: &v1::RemoveRequest) -> v1::RemoveResponse {
        let mut next = self.clone();
        let removed = request
            .ids
            .iter()
            .filter(|id| next.points.remove(id).is_some())
            .count() as u64;
        self.take(next, removed > 0);
        v1::RemoveResponse {
            removed_count: removed,
            missing_count: request.ids.len() as u64 - removed,
            revision: revision(&self.uid, self.revision),
        }
    }

    fn take(&mut self, next: Model, changed: bool) {
        *self = next;
        self.revision += u64::from(changed);
    }

    pub(crate) fn knn(&self, request: &v1::KnnRequest) -> v1::KnnResponse {
        let rows = canonical(&self.space, &request.states.as_ref().unwrap().coordinates);
        let mut found = Columns::new(request.include);
        let (k, radius) = self.bounds(
            request.k_form.map(Into::into),
            request.radius_form.map(Into::into),
        );
        for row in rows.chunks(self.space.coordinates()) {
            let mut all = self.within(row, radius, request.filter.as_ref());
            all.truncate(k);
            found.push(self, &all);
        }
        v1::KnnResponse {
            neighbors: Some(found.columns),
            revision: revision(&self.uid, self.revision),
        }
    }

    pub(crate) fn scan(&self, request: &v1::ScanRequest) -> v1::ScanResponse {
        let after = request.after_id;
        let passing = self.points.iter().filter(|(id, point)| {
            after.is_none_or(|after| **id > after) && passes(request.filter.as_ref(), point)
        });
        v1::ScanResponse {
            points: Some(columns(passing, request.include)),
            revision: revision(&self.uid, self.revision),
            point_count: self.points.len() as u64,
            held_scan: String::new(),
        }
    }

    pub(crate) fn get(&self, request: &v1::GetRequest) -> Result<v1::GetResponse, Refused> {
        let missing: Vec<u64> = request
            .ids
            .iter()
            .copied()
            .filter(|id| !self.points.contains_key(id))
            .collect();
        if !missing.is_empty() {
            return Err(Refused::Missing(missing));
        }
        let requested = request.ids.iter().map(|id| (id, &self.points[id]));
        Ok(v1::GetResponse {
            points: Some(columns(requested, request.include)),
            revision: revision(&self.uid, self.revision),
        })
    }

    /// The number and the radius of a request, scaled by the present number of points after Karaman and Frazzoli. The
    /// radius equals no distance between the few states, so its last bit does not matter.
    fn bounds(&self, count: Option<KForm>, radius_form: Option<RadiusForm>) -> (usize, f64) {
        let n = self.points.len() as f64;
        let k = match count {
            None => usize::MAX,
            Some(KForm::K(k)) => k as usize,
            Some(KForm::KFactor(factor)) => {
                let k = if n > 1.0 { factor * n.ln() } else { 0.0 };
                (k.ceil() as usize).max(1)
            }
        };
        let scaled = |scaled: v1::ScaledRadius| {
            let terms = self.space.groups().iter().flat_map(|group| &group.terms);
            let dimensions = terms.map(|term| match term.factor {
                Factor::RealVector(n) => n,
                Factor::SO2 { .. } => 1,
                Factor::SO3 => 3,
            });
            let root = 1.0 / dimensions.sum::<usize>() as f64;
            let max = scaled.max.unwrap_or(f64::INFINITY);
            match n > 1.0 {
                true => max.min(scaled.factor * (n.ln() / n).powf(root)),
                false => max,
            }
        };
        let radius = match radius_form {
            None => f64::INFINITY,
            Some(RadiusForm::Radius(radius)) => radius,
            Some(RadiusForm::ScaledRadius(radius)) => scaled(radius),
        };
        (k, radius)
    }

    /// All points within `radius`, by (distance, id).
    fn within(&self, row: &[f64], radius: f64, filter: Option<&v1::Filter>) -> Vec<(f64, u64)> {
        let passing = self
            .points
            .iter()
            .filter(|(_, point)| passes(filter, point));
        let mut all: Vec<(f64, u64)> = passing
            .map(|(id, point)| (self.space.distance(row, &point.row), *id))
            .filter(|(distance, _)| *distance <= radius)
            .collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        all
    }
}

fn passes(filter: Option<&v1::Filter>, point: &Point) -> bool {
    let filter = filter.cloned().unwrap_or_default();
    let since = filter.since_revision.map_or(0, |since| since.number);
    point.tag & filter.tag_mask == filter.tag_value && point.stored > since
}

fn columns<'a>(
    points: impl Iterator<Item = (&'a u64, &'a Point)>,
    include: Option<v1::Include>,
) -> v1::Points {
    let include = include.unwrap_or(v1::Include {
        with_states: true,
        with_tags: true,
        with_revisions: true,
        with_payloads: false,
    });
    let mut columns = v1::Points {
        states: include.with_states.then(v1::States::default),
        ..Default::default()
    };
    for (id, point) in points {
        columns.ids.push(*id);
        if include.with_tags {
            columns.tags.push(point.tag);
        }
        if include.with_revisions {
            columns.revisions.push(point.stored);
        }
        if let Some(states) = &mut columns.states {
            states.row_count += 1;
            states.coordinates.extend(&point.row);
        }
        if include.with_payloads {
            columns.payloads.push(point.payload.clone());
        }
    }
    columns
}

struct Columns {
    include: v1::Include,
    columns: v1::Neighbors,
}

impl Columns {
    fn new(include: Option<v1::Include>) -> Self {
        let include = include.unwrap_or_default();
        let states = include.with_states.then(v1::States::default);
        let columns = v1::Neighbors {
            states,
            ..Default::default()
        };
        Self { include, columns }
    }

    fn push(&mut self, model: &Model, neighbors: &[(f64, u64)]) {
        self.columns.neighbor_counts.push(neighbors.len() as u32);
        for (distance, id) in neighbors {
            let point = &model.points[id];
            self.columns.ids.push(*id);
            self.columns.distances.push(*distance);
            if let Some(states) = &mut self.columns.states {
                states.row_count += 1;
                states.coordinates.extend(&point.row);
            }
            if self.include.with_tags {
                self.columns.tags.push(point.tag);
            }
            if self.include.with_revisions {
                self.columns.revisions.push(point.stored);
            }
            if self.include.with_payloads {
                self.columns.payloads.push(point.payload.clone());
            }
        }
    }
}
