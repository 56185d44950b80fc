//! A brute-force model of an index, which checks every answer of a server.

mod messages;
mod update;

use std::collections::{BTreeMap, HashMap, HashSet};

use prost::bytes::Bytes;
use wayfold_index::{Linear, PointRef, Search, Space};
use wayfold_proto::v1::{
    self, GetRequest, GetResponse, InsertRequest, InsertResponse, KnnRequest, KnnResponse,
    NeighborSpec, Neighbors, OnConflict, Outcome, QueryRequest, QueryResponse, RemoveRequest,
    RemoveResponse, StepKind, WriteRequest, WriteResponse,
};

use crate::{Content, StoredPoint, bits, brute_force::pairs, ledger::Entry, number};
use messages::{expected_rows, search};

/// The content that an index must hold at one revision.
///
/// It receives mutations in the order of their revisions, and computes the expected answer of each.
#[derive(Clone, Debug)]
pub struct Model {
    points: Linear,
    payloads: HashMap<u64, Bytes>,
    revision: u64,
    highest_id: Option<u64>,
}

impl Model {
    /// The model of a newly created index.
    pub fn new(space: Space) -> Self {
        Self {
            points: Linear::new(space),
            payloads: HashMap::new(),
            revision: 0,
            highest_id: None,
        }
    }

    /// The number of received mutations.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// Takes the revisions up to this one for records without effect: servers that share a journal write such records.
    pub fn skip_to(&mut self, revision: u64) {
        self.revision = self.revision.max(revision);
    }

    /// Checks an answer, and applies the call if it is a mutation.
    ///
    /// # Panics
    /// If brute force answers otherwise, or the answer does not belong to this revision or, for a mutation that
    /// changed something, the next.
    pub fn check(&mut self, entry: &Entry) {
        match entry {
            Entry::Insert(request, response) => self.insert(request, response),
            Entry::Remove(request, response) => self.remove(request, response),
            Entry::Update(request, response) => self.update(request, response),
            Entry::OpenSession(_, response) => {
                self.revision += 1;
                assert_eq!(response.session, self.revision);
                self.reserve(response.reserved);
                assert_eq!(number(&response.revision), self.revision);
            }
            Entry::Write(request, response) => self.write(request, response),
            Entry::Knn(request, response) => self.knn(request, response),
            Entry::Query(request, response) => self.query(request, response),
        }
    }

    /// Checks an insert's outcomes, ids and neighbours, and applies it.
    ///
    /// # Panics
    /// Panics where [`Model::check`] does.
    pub fn insert(&mut self, request: &InsertRequest, response: &InsertResponse) {
        let rows = self.canonical(request.states.as_ref());
        assert_eq!(response.outcomes.len(), rows.len());
        assert_eq!(response.ids.len(), rows.len());
        let found = self.revision;
        let mut neighbors =
            expected_rows(request.neighbor_spec.is_some(), response.neighbors.as_ref());
        for (i, row) in rows.iter().enumerate() {
            let id = request.ids.get(i).copied();
            if let Some(query) = &request.neighbor_spec {
                let expected = self.neighbors(query, row, id);
                let entry = neighbors.next().expect("an entry a row");
                assert_eq!(entry, expected, "neighbours of row {i} of {request:?}");
            }
            let tag = request.tags.get(i).copied().unwrap_or_default();
            let payload = request.payloads.get(i).cloned().unwrap_or_default();
            let (outcome, expected_id) = self.outcome(request, row, id, tag, &payload);
            assert_eq!(response.outcomes[i], outcome as i32, "row {i}: {request:?}");
            let told_id = response.ids[i];
            match expected_id {
                Some(expected) => assert_eq!(told_id, expected, "row {i} of {request:?}"),
                None => assert!(Some(told_id) > self.highest_id, "{told_id} was used before"),
            }
            if matches!(outcome, Outcome::Inserted | Outcome::Replaced) {
                self.revision = found + 1;
                self.points
                    .insert(PointRef {
                        id: told_id,
                        tag,
                        revision: self.revision,
                        row,
                    })
                    .expect("a canonical row");
                self.payloads.insert(told_id, payload);
                self.highest_id = self.highest_id.max(Some(told_id));
            }
        }
        assert_eq!(neighbors.next(), None);
        assert_eq!(number(&response.revision), self.revision);
    }

    /// Checks a removal and applies it.
    ///
    /// # Panics
    /// Panics where [`Model::check`] does.
    pub fn remove(&mut self, request: &RemoveRequest, response: &RemoveResponse) {
        let mut removed = 0;
        for &id in &request.ids {
            removed += u64::from(self.points.remove(id));
            self.payloads.remove(&id);
        }
        self.revision += u64::from(removed > 0);
        let missing = request.ids.len() as u64 - removed;
        assert_eq!(
            (response.removed_count, response.missing_count),
            (removed, missing),
            "{request:?}"
        );
        assert_eq!(number(&response.revision), self.revision, "{request:?}");
    }

    /// Applies the steps of a batch one by one, and checks the answer.
    ///
    /// # Panics
    /// Panics where [`Model::check`] does.
    pub fn write(&mut self, request: &WriteRequest, response: &WriteResponse) {
        self.revision += 1;
        let mut rows = self.canonical(request.states.as_ref()).into_iter();
        let mut payloads = request.payloads.iter();
        let mut missing = 0;
        for (at, (kind, &id)) in request.kinds().zip(&request.ids).enumerate() {
            let stored = self.points.get(id);
            let old_tag = stored.map(|point| point.tag);
            let old = stored.map(|point| (point.row.to_vec(), point.revision));
            let stored = match (kind, old) {
                (StepKind::Put, _) => {
                    let payload = payloads.next().cloned().unwrap_or_default();
                    self.payloads.insert(id, payload);
                    self.highest_id = self.highest_id.max(Some(id));
                    Some((rows.next().expect("a state a put"), self.revision))
                }
                (StepKind::SetTag, Some(old)) => Some(old),
                (StepKind::SetPayload, old) => {
                    let payload = payloads.next().cloned().unwrap_or_default();
                    missing += u64::from(old.is_none());
                    if old.is_some() {
                        self.payloads.insert(id, payload);
                    }
                    old
                }
                (StepKind::Replace, old) => {
                    let payload = payloads.next().cloned().unwrap_or_default();
                    let row = rows.next().expect("a state a replacement");
                    missing += u64::from(old.is_none());
                    old.map(|_| {
                        self.payloads.insert(id, payload);
                        (row, self.revision)
                    })
                }
                (StepKind::Remove, Some(_)) => {
                    self.points.remove(id);
                    self.payloads.remove(&id);
                    None
                }
                (StepKind::SetTag | StepKind::Remove, None) => {
                    missing += 1;
                    None
                }
                (StepKind::Unspecified, _) => panic!("{request:?}"),
            };
            if let Some((row, revision)) = stored {
                let point = PointRef {
                    id,
                    tag: match (kind, old_tag) {
                        (StepKind::Replace | StepKind::SetPayload, Some(tag)) => tag,
                        _ => request.tags.get(at).copied().unwrap_or_default(),
                    },
                    revision,
                    row: &row,
                };
                self.points.insert(point).expect("a canonical row");
            }
        }
        self.reserve(response.reserved);
        assert_eq!(
            (response.missing_count, number(&response.revision)),
            (missing, self.revision),
            "{request:?}"
        );
    }

    /// Checks that reserved ids were never used, and uses them.
    fn reserve(&mut self, ids: Option<v1::IdBlock>) {
        let ids = ids.expect("a block");
        if let Some(last) = ids.id_count.checked_sub(1) {
            assert!(Some(ids.first_id) > self.highest_id, "{ids:?} was used");
            self.highest_id = Some(ids.first_id + last);
        }
    }

    /// Checks the answer to a Knn.
    ///
    /// # Panics
    /// Panics where [`Model::check`] does.
    pub fn knn(&self, request: &KnnRequest, response: &KnnResponse) {
        assert_eq!(number(&response.revision), self.revision);
        let search = search(
            request.k_form.map(Into::into),
            request.radius_form.map(Into::into),
            request.filter.as_ref(),
        );
        self.searched(
            request.states.as_ref(),
            &search,
            response.neighbors.as_ref(),
        );
    }

    /// Checks the answer to a Query.
    ///
    /// # Panics
    /// Panics where [`Model::check`] does.
    pub fn query(&self, request: &QueryRequest, response: &QueryResponse) {
        assert_eq!(number(&response.revision), self.revision);
        let radius_form = request.radius_form.expect("a radius");
        let search = search(None, Some(radius_form.into()), request.filter.as_ref());
        self.searched(
            request.states.as_ref(),
            &search,
            response.neighbors.as_ref(),
        );
    }

    /// Checks the answer to a Get with payloads.
    ///
    /// # Panics
    /// Panics where [`Model::check`] does.
    pub fn get(&self, request: &GetRequest, response: &GetResponse) {
        assert_eq!(number(&response.revision), self.revision);
        let stored = response.points.as_ref().expect("points");
        let rows = stored.states.as_ref().expect("states");
        assert_eq!(stored.ids, request.ids);
        assert_eq!(rows.row_count as usize, stored.ids.len());
        let width = self.points.space().coordinates();
        for (i, id) in stored.ids.iter().enumerate() {
            let point = self.points.get(*id).expect("a point that was there");
            let row = &rows.coordinates[i * width..][..width];
            assert_eq!(
                (bits(row), stored.tags[i], stored.revisions[i]),
                (bits(point.row), point.tag, point.revision),
                "point {id} at revision {}",
                self.revision
            );
            assert_eq!(stored.payloads[i], self.payloads[id]);
        }
    }

    /// Checks that an index holds exactly the model's content.
    ///
    /// # Panics
    /// If it does not.
    pub fn check_content(&self, content: &Content) {
        assert_eq!(content.revision, self.revision);
        let expected = self.points.iter().map(|point| {
            let stored = StoredPoint {
                state: bits(point.row),
                tag: point.tag,
                revision: point.revision,
                payload: self.payloads[&point.id].to_vec(),
            };
            (point.id, stored)
        });
        assert_eq!(content.points, expected.collect::<BTreeMap<_, _>>());
    }

    fn searched(
        &self,
        states: Option<&v1::States>,
        search: &Search<'_>,
        neighbors: Option<&Neighbors>,
    ) {
        let rows = self.canonical(states);
        let mut entries = expected_rows(true, neighbors);
        for (i, row) in rows.iter().enumerate() {
            let entry = entries.next().expect("an entry a state");
            let expected = self.search(row, search);
            assert_eq!(entry, expected, "state {i} at revision {}", self.revision);
        }
        assert_eq!(entries.next(), None);
    }

    fn neighbors(&self, spec: &NeighborSpec, row: &[f64], id: Option<u64>) -> Vec<(u64, u64)> {
        let own = HashSet::from_iter(id);
        let search = Search {
            excluded: &[&own],
            ..search(spec.k_form, spec.radius_form, spec.filter.as_ref())
        };
        self.search(row, &search)
    }

    /// The required outcome of a row, and its id; None if the server assigns the id.
    fn outcome(
        &self,
        request: &InsertRequest,
        row: &[f64],
        id: Option<u64>,
        tag: u64,
        payload: &Bytes,
    ) -> (Outcome, Option<u64>) {
        let stored = id.and_then(|id| self.points.get(id));
        if let Some(stored) = stored
            && bits(stored.row) == bits(row)
            && stored.tag == tag
            && self.payloads[&stored.id] == *payload
        {
            return (Outcome::Unchanged, id);
        }
        let own = HashSet::from_iter(id);
        let nearest = Search {
            excluded: &[&own],
            ..Search::nearest_k(1)
        };
        if request.min_separation > 0.0
            && let Some(nearest) = self
                .points
                .search(row, &nearest)
                .expect("a canonical row")
                .neighbors
                .first()
            && nearest.distance < request.min_separation
        {
            return (Outcome::TooClose, Some(nearest.id));
        }
        if stored.is_none() {
            return (Outcome::Inserted, id);
        }
        assert_eq!(request.on_conflict(), OnConflict::Replace, "{request:?}");
        (Outcome::Replaced, id)
    }

    fn search(&self, row: &[f64], search: &Search<'_>) -> Vec<(u64, u64)> {
        let neighbors = self
            .points
            .search(row, search)
            .expect("a canonical row")
            .neighbors;
        pairs(neighbors)
    }

    fn canonical(&self, states: Option<&v1::States>) -> Vec<Vec<f64>> {
        let states = states.expect("states");
        let space = self.points.space();
        let rows = states.coordinates.chunks_exact(space.coordinates());
        let rows: Vec<Vec<f64>> = rows
            .map(|row| {
                let mut row = row.to_vec();
                space.canonicalize(&mut row).expect("a valid state");
                row
            })
            .collect();
        assert_eq!(rows.len(), states.row_count as usize);
        rows
    }
}
