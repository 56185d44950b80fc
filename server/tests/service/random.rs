//! Random mutations and reads, each answer compared in bits with the model's.

use std::fmt::Debug;

use bytes::Bytes;
use prost::Message;
use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold_index::{Factor, Space};
use wayfold_proto::v1::{
    self,
    neighbor_spec::{KForm, RadiusForm},
};
use wayfold_server::service::{Error, Service};

use crate::{
    model::{Model, Refused},
    support::*,
};

#[derive(Clone, Debug)]
pub(crate) enum Mutation {
    Insert(v1::InsertRequest),
    Update(v1::UpdateRequest),
    Remove(v1::RemoveRequest),
}

/// The answer to a mutation, as text and as encoded bytes, so that comparisons are exact to the last bit.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Answer {
    pub(crate) revision: u64,
    text: String,
    encoded: Vec<u8>,
}

pub(crate) type Reply = Result<Answer, Refused>;

impl Answer {
    fn new(message: &(impl Message + Debug), revision: u64) -> Self {
        Self {
            revision,
            text: format!("{message:?}"),
            encoded: message.encode_to_vec(),
        }
    }
}

impl Mutation {
    pub(crate) async fn send(&self, service: &Service) -> Result<Answer, Error> {
        Ok(match self.clone() {
            Self::Insert(request) => {
                let answer = service.insert(&CALL, request).await?;
                Answer::new(&answer, answer.revision.number())
            }
            Self::Update(request) => {
                let answer = service.update(&CALL, request).await?;
                Answer::new(&answer, answer.revision.number())
            }
            Self::Remove(request) => {
                let answer = service.remove(&CALL, request).await?;
                Answer::new(&answer, answer.revision.number())
            }
        })
    }

    pub(crate) fn apply(&self, model: &mut Model) -> Reply {
        Ok(match self {
            Self::Insert(request) => Answer::new(&model.insert(request)?, model.revision),
            Self::Update(request) => Answer::new(&model.update(request)?, model.revision),
            Self::Remove(request) => Answer::new(&model.remove(request), model.revision),
        })
    }
}

/// Requests from few values, so that duplicates, ties and conflicts are common.
pub(crate) struct Requests {
    pub(crate) random: ChaCha8Rng,
    space: Space,
    name: String,
    uid: String,
}

impl Requests {
    pub(crate) fn new(seed: u64, space: &Space, uid: &str) -> Self {
        Self {
            random: ChaCha8Rng::seed_from_u64(seed),
            space: space.clone(),
            name: "arm".into(),
            uid: uid.into(),
        }
    }

    /// The same requests for an index with another name than `arm`.
    pub(crate) fn named(self, name: &str) -> Self {
        let name = name.into();
        Self { name, ..self }
    }

    fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        *of.choose(&mut self.random).unwrap()
    }

    fn row(&mut self) -> Vec<f64> {
        let space = self.space.clone();
        let mut row = Vec::new();
        for term in space.groups().iter().flat_map(|group| &group.terms) {
            match term.factor {
                Factor::RealVector(n) => {
                    row.extend((0..n).map(|_| self.pick(&[0.0, 0.25, 0.5, 0.75, 1.0])));
                }
                Factor::SO2 { period } => {
                    row.push(period / 8.0 * f64::from(self.random.random_range(-6..10)));
                }
                Factor::SO3 => row.extend(self.pick(&[
                    [0.0, 0.0, 0.0, 1.0],
                    [0.0, 0.0, 0.0, -1.0],
                    [1.0, 0.0, 0.0, 0.0],
                    [-0.6, 0.0, 0.8, 0.0],
                    [0.5, 0.5, -0.5, 0.5],
                    [0.1, 0.7, 0.1, 0.7],
                ])),
            }
        }
        row
    }

    pub(crate) fn states(&mut self, rows: u32) -> Option<v1::States> {
        let coordinates = (0..rows).flat_map(|_| self.row()).collect();
        Some(v1::States {
            row_count: rows,
            coordinates,
        })
    }

    fn ids(&mut self, most: usize) -> Vec<u64> {
        let count = self.random.random_range(0..=most);
        let mut ids: Vec<u64> = (0..count)
            .map(|_| self.random.random_range(0..60))
            .collect();
        let mut seen = std::collections::HashSet::new();
        ids.retain(|id| seen.insert(*id));
        ids
    }

    pub(crate) fn tags(&mut self, count: usize) -> Vec<u64> {
        (0..count).map(|_| self.random.random_range(0..4)).collect()
    }

    pub(crate) fn payloads(&mut self, count: usize) -> Vec<Bytes> {
        let payloads = [&b""[..], b"a", b"bb"];
        (0..count)
            .map(|_| Bytes::from_static(self.pick(&payloads)))
            .collect()
    }

    fn filter(&mut self, revision: u64) -> Option<v1::Filter> {
        let tag_mask = self.pick(&[0, 0b01, 0b11]);
        let is_filtered = self.random.random_bool(0.5);
        is_filtered.then(|| v1::Filter {
            tag_mask,
            tag_value: self.random.random_range(0..4) & tag_mask,
            since_revision: self.at(revision),
        })
    }

    fn include(&mut self) -> Option<v1::Include> {
        Some(v1::Include {
            with_states: self.random.random(),
            with_tags: self.random.random(),
            with_revisions: self.random.random(),
            with_payloads: self.random.random(),
        })
    }

    pub(crate) fn insert(&mut self, revision: u64) -> v1::InsertRequest {
        let mut ids = Vec::new();
        if self.random.random_bool(0.7) {
            ids = self.ids(8);
        }
        let rows = match ids.len() {
            0 => self.random.random_range(0..6),
            given => given,
        };
        let tags = if self.random.random() {
            self.tags(rows)
        } else {
            vec![]
        };
        let payloads = if self.random.random() {
            self.payloads(rows)
        } else {
            vec![]
        };
        let neighbor_spec = self.random.random_bool(0.5).then(|| {
            let k = self
                .random
                .random_bool(0.6)
                .then(|| self.random.random_range(1..6));
            let radius = self.pick(&[0.0, 0.3, 1.0, f64::INFINITY]);
            let radius = (k.is_none() || self.random.random()).then_some(radius);
            v1::NeighborSpec {
                k_form: self.k_factor().or(k.map(KForm::K)),
                radius_form: self.scaled_radius().or(radius.map(RadiusForm::Radius)),
                filter: self.filter(revision + 1),
                include: self.include(),
            }
        });
        v1::InsertRequest {
            index_name: self.name.clone(),
            states: self.states(rows as u32),
            ids,
            tags,
            payloads,
            on_conflict: self.pick(&[0, 1, 2, 2]),
            min_separation: self.pick(&[0.0, 0.0, 0.25, 0.5, 0.7]),
            neighbor_spec,
            operation_id: String::new(),
            uid: self.uid.clone(),
        }
    }

    pub(crate) fn update(&mut self, revision: u64) -> v1::UpdateRequest {
        let ids = self.ids(3);
        let tag_count = self.pick(&[0, 1, ids.len()]);
        let payload_count = self.pick(&[0, ids.len()]);
        let compares = self.random.random_bool(0.3);
        let mut tags = self.tags(tag_count);
        let masks = [None, Some(0), Some(0b01), Some(0b10)];
        let tag_mask = (tag_count > 0).then(|| self.pick(&masks)).flatten();
        tags.iter_mut()
            .for_each(|tag| *tag &= tag_mask.unwrap_or(u64::MAX));
        v1::UpdateRequest {
            index_name: self.name.clone(),
            tags,
            tag_mask,
            payloads: self.payloads(payload_count),
            if_revision: self.at(revision).filter(|_| compares),
            operation_id: String::new(),
            uid: self.uid.clone(),
            ids,
        }
    }

    pub(crate) fn remove(&mut self) -> v1::RemoveRequest {
        v1::RemoveRequest {
            index_name: self.name.clone(),
            ..removal(&self.ids(5))
        }
    }

    /// Five inserts to two updates and a removal.
    pub(crate) fn mutation(&mut self, revision: u64, operation_id: String) -> Mutation {
        match self.random.random_range(0..8) {
            0..=4 => Mutation::Insert(v1::InsertRequest {
                operation_id,
                ..self.insert(revision)
            }),
            5..=6 => Mutation::Update(v1::UpdateRequest {
                operation_id,
                ..self.update(revision)
            }),
            _ => Mutation::Remove(v1::RemoveRequest {
                operation_id,
                ..self.remove()
            }),
        }
    }

    /// A number scaled by the size of the index, in some of the requests.
    fn k_factor(&mut self) -> Option<KForm> {
        let factor = self.pick(&[None, None, Some(0.0), Some(0.7), Some(1.5), Some(5.5)]);
        factor.map(KForm::KFactor)
    }

    /// A radius scaled by the size of the index, in some of the requests.
    fn scaled_radius(&mut self) -> Option<RadiusForm> {
        let factor = self.pick(&[None, None, Some(0.0), Some(0.4), Some(1.1)])?;
        let max = self.pick(&[None, Some(0.3), Some(f64::INFINITY)]);
        Some(RadiusForm::ScaledRadius(v1::ScaledRadius { factor, max }))
    }

    pub(crate) fn knn(&mut self, revision: u64) -> v1::KnnRequest {
        let radius = self.pick(&[0.0, 0.3, 1.0, f64::INFINITY]);
        let radius = self.random.random_bool(0.5).then_some(radius);
        let count = self.k_factor();
        let count = count.unwrap_or_else(|| KForm::K(self.random.random_range(1..80)));
        let radius_form = self.scaled_radius().or(radius.map(RadiusForm::Radius));
        v1::KnnRequest {
            index_name: self.name.clone(),
            states: self.states(2),
            k_form: Some(count.into()),
            radius_form: radius_form.map(Into::into),
            filter: self.filter(revision),
            include: self.include(),
            min_revision: self.at(revision),
            ..Default::default()
        }
    }

    pub(crate) fn scan(&mut self, revision: u64) -> v1::ScanRequest {
        v1::ScanRequest {
            index_name: self.name.clone(),
            filter: self.filter(revision),
            include: self.columns(),
            after_id: self
                .random
                .random_bool(0.3)
                .then(|| self.random.random_range(0..60)),
            min_revision: self.at(revision),
            ..Default::default()
        }
    }

    fn at(&mut self, newest: u64) -> Option<v1::Revision> {
        revision(&self.uid, self.random.random_range(0..=newest))
    }

    /// The requested columns of points; None, the default, in some requests.
    fn columns(&mut self) -> Option<v1::Include> {
        let include = self.include();
        include.filter(|_| self.random.random())
    }
}

/// `Query` is `Knn` without k.
fn as_query(knn: &v1::KnnRequest) -> v1::QueryRequest {
    let radius_form = knn.radius_form.map_or(RadiusForm::Radius(0.5), Into::into);
    v1::QueryRequest {
        index_name: knn.index_name.clone(),
        states: knn.states.clone(),
        radius_form: Some(radius_form.into()),
        filter: knn.filter.clone(),
        include: knn.include,
        min_revision: knn.min_revision.clone(),
        ..Default::default()
    }
}

pub(crate) fn refused<T>(answer: Result<T, Error>) -> Result<T, Refused> {
    answer.map_err(|error| match error {
        Error::PointsExist { ids, .. } => Refused::Exist(ids),
        Error::PointsNotFound { ids, .. } => Refused::Missing(ids),
        Error::RevisionConflict { ids, .. } => Refused::Changed(ids),
        other => panic!("{other}"),
    })
}

/// Compares to the last bit, including the sign of zeros.
pub(crate) fn assert_same<M: Message + PartialEq + Debug>(
    answer: Result<M, Error>,
    expected: Result<M, Refused>,
    what: &str,
) {
    let answer = refused(answer);
    let bits = |answer: &Result<M, Refused>| answer.as_ref().ok().map(Message::encode_to_vec);
    assert_eq!(answer, expected, "{what}");
    assert_eq!(bits(&answer), bits(&expected), "{what}");
}

pub(crate) async fn compare(service: &Service, model: &Model, requests: &mut Requests) {
    let knn = requests.knn(model.revision);
    assert_same(
        service.knn(&CALL, knn.clone()).await,
        Ok(model.knn(&knn)),
        &format!("{knn:?}"),
    );

    let query = as_query(&knn);
    let unlimited = v1::KnnRequest {
        k_form: nearest(u32::MAX).map(Into::into),
        radius_form: query.radius_form.map(RadiusForm::from).map(Into::into),
        ..knn
    };
    let expected = model.knn(&unlimited);
    let answer = service.query(&CALL, query.clone()).await.unwrap();
    assert_eq!(answer.neighbors, expected.neighbors, "{query:?}");
    assert_eq!(answer.revision, revision(&model.uid, model.revision));

    let get = v1::GetRequest {
        index_name: requests.name.clone(),
        include: requests.columns(),
        ..getting(&requests.ids(4))
    };
    assert_same(
        service.get(&CALL, get.clone()).await,
        model.get(&get),
        &format!("{get:?}"),
    );
}
