//! The script: operations drawn from a seed, with few values, so that ties and conflicts are common, and those of
//! [`by_hand`].

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1::{self, knn_request, neighbor_spec, query_request};

use super::{
    by_hand::{AFTER, by_hand},
    op::Op,
    outcome::{Outcome, UID},
    scaling,
};

/// The operations, drawn one by one, because some depend on the newest revision.
pub(crate) struct Script {
    random: ChaCha8Rng,
    by_hand: VecDeque<Op>,
    left: usize,
    revision: u64,
}

impl Script {
    pub(crate) fn new(seed: u64, random: usize) -> Self {
        Self {
            random: ChaCha8Rng::seed_from_u64(seed),
            by_hand: by_hand().into(),
            left: random,
            revision: 0,
        }
    }

    /// Learns from the outcome of the last operation.
    pub(crate) fn learn(&mut self, outcome: &Outcome) {
        if let Outcome::Reply { revision, .. } = outcome {
            self.revision = self.revision.max(*revision);
        }
    }

    pub(crate) fn next(&mut self) -> Option<Op> {
        // The index is created first and deleted last.
        if self.left > 0 && self.by_hand.len() == AFTER {
            self.left -= 1;
            let mut op = self.draw();
            scaling::scale(&mut op, &mut self.random);
            return Some(op);
        }
        self.by_hand.pop_front()
    }

    fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        *of.choose(&mut self.random).unwrap()
    }

    fn chance(&mut self, probability: f64) -> bool {
        self.random.random_bool(probability)
    }

    fn draw(&mut self) -> Op {
        match self.random.random_range(0..100) {
            0..35 => Op::Insert(self.insert()),
            35..45 => Op::Update(self.update()),
            45..55 => Op::Remove(v1::RemoveRequest {
                ids: self.ids(4),
                operation_id: self.operation_id(),
                uid: self.uid(),
                index_name: self.index(),
            }),
            55..65 => Op::Get(v1::GetRequest {
                ids: self.ids(2),
                include: self.include(),
                min_revision: self.min_revision(),
                latest: false,
                index_name: self.index(),
            }),
            // The request keeps the search exact: an inexact one depends on how the trees were merged.
            65..80 => Op::Knn(v1::KnnRequest {
                states: self.states(3),
                k_form: self.k().map(knn_request::KForm::K),
                radius_form: self.radius().map(knn_request::RadiusForm::Radius),
                epsilon: self.pick(&[0.0, 0.0, 0.0, 1e-300, 1e-300, 0.0, 0.0, -1.0]),
                filter: self.filter(),
                include: self.include(),
                min_revision: self.min_revision(),
                latest: false,
                index_name: self.index(),
            }),
            80..90 => Op::Query(v1::QueryRequest {
                states: self.states(3),
                radius_form: self.radius().map(query_request::RadiusForm::Radius),
                epsilon: self.pick(&[0.0, 0.0, 0.0, 0.0, 0.0, 1e-300, f64::INFINITY]),
                filter: self.filter(),
                include: self.include(),
                min_revision: self.min_revision(),
                latest: false,
                index_name: self.index(),
            }),
            90..95 => Op::Log(v1::WatchRequest {
                after_revision: self.revision_or_none(),
                include: self.include(),
                own_session: self.pick(&[0, 1, 2, u64::MAX]),
                index_name: self.index(),
            }),
            95..98 => Op::Info(v1::GetIndexRequest {
                index_name: self.index(),
            }),
            _ => Op::List(v1::ListIndexesRequest {
                page_size: self.pick(&[0, 1]),
                page_token: String::new(),
            }),
        }
    }

    fn insert(&mut self) -> v1::InsertRequest {
        let states = self.states(5);
        let rows = states
            .as_ref()
            .map_or(0, |states| states.row_count as usize);
        let mut column = |most: u64| -> Vec<u64> {
            let length = match self.random.random_range(0..50) {
                0..25 => 0,
                25..49 => rows,
                _ => rows + 1,
            };
            (0..length)
                .map(|_| self.random.random_range(0..most))
                .collect()
        };
        let (ids, tags) = (column(25), column(u64::MAX));
        let payloads = (0..column(2).len()).map(|_| self.payload()).collect();
        let neighbor_spec = self.chance(0.4).then(|| {
            let k = self.pick(&[None, Some(1), Some(4), Some(4), Some(9), Some(0)]);
            v1::NeighborSpec {
                k_form: k.map(neighbor_spec::KForm::K),
                radius_form: self.radius().map(neighbor_spec::RadiusForm::Radius),
                filter: self.filter(),
                include: self.include(),
            }
        });
        v1::InsertRequest {
            states,
            ids,
            tags,
            payloads,
            on_conflict: self.pick(&[0, 1, 2, 2, 2, 2, 2, 2, 2, 2, 2, 7]),
            min_separation: self.pick(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 0.3, f64::NAN]),
            neighbor_spec,
            operation_id: self.operation_id(),
            uid: self.uid(),
            index_name: self.index(),
        }
    }

    fn update(&mut self) -> v1::UpdateRequest {
        let ids = self.ids(3);
        let tags: Vec<u64> = match self.random.random_range(0..3) {
            0 => vec![],
            1 => vec![self.random.random_range(0..8)],
            _ => ids.iter().map(|id| id % 8).collect(),
        };
        let payloads = match self.chance(0.4) {
            true => ids.iter().map(|_| self.payload()).collect(),
            false => vec![],
        };
        v1::UpdateRequest {
            tag_mask: self.pick(&[None, None, None, None, None, Some(7), Some(u64::MAX)]),
            ids,
            tags,
            payloads,
            if_revision: if self.chance(0.2) {
                self.revision_or_none()
            } else {
                None
            },
            operation_id: self.operation_id(),
            uid: self.uid(),
            index_name: self.index(),
        }
    }

    fn row(&mut self) -> [f64; 5] {
        let [x, angle, z] = [(); 3].map(|()| self.pick(&[0.0, -0.0, 0.1, 1.0 / 3.0, 7.5, 1e-300]));
        let [a, b] = self.pick(&[[0.0, 1.0], [0.6, 0.8], [0.8, -0.6]]);
        [x, angle + z, z, a, b]
    }

    /// States of R1*SO2*R3, mostly.
    fn states(&mut self, most: u32) -> Option<v1::States> {
        let rows = self.random.random_range(1..=most);
        let mut coordinates: Vec<f64> = (0..rows).flat_map(|_| self.row()).collect();
        match self.random.random_range(0..40) {
            0 => return None,
            1 => drop(coordinates.pop()),
            2 => coordinates[3] = f64::NAN,
            3 => coordinates[0] = f64::NEG_INFINITY,
            4 => coordinates[4] = 1e200,
            5 => return Some(v1::States::default()),
            6 => coordinates.extend(std::iter::repeat_n(0.5, rows as usize)),
            _ => {}
        }
        Some(v1::States {
            row_count: rows,
            coordinates,
        })
    }

    fn ids(&mut self, most: usize) -> Vec<u64> {
        let count = self.random.random_range(1..=most);
        (0..count)
            .map(|_| match self.random.random_range(0..60) {
                0 => self.pick(&[1 << 53, (1 << 53) - 1, (1 << 63) - 1, 1 << 63, u64::MAX]),
                _ => self.random.random_range(0..14),
            })
            .collect()
    }

    fn payload(&mut self) -> prost::bytes::Bytes {
        let length = self.random.random_range(0..6);
        (0..length)
            .map(|_| self.random.random::<u8>())
            .collect::<Vec<_>>()
            .into()
    }

    fn k(&mut self) -> Option<u32> {
        let k = self.pick(&[1, 2, 3, 4, 5, 9, 40, 50, 0, 20_000]);
        self.chance(0.95).then_some(k)
    }

    fn radius(&mut self) -> Option<f64> {
        self.pick(&[None, Some(0.0), Some(0.4), Some(2.0), Some(f64::INFINITY)])
    }

    fn include(&mut self) -> Option<v1::Include> {
        self.chance(0.4).then(|| v1::Include {
            with_states: self.chance(0.5),
            with_tags: self.chance(0.5),
            with_revisions: self.chance(0.5),
            with_payloads: self.chance(0.5),
        })
    }

    fn filter(&mut self) -> Option<v1::Filter> {
        self.chance(0.3).then(|| {
            let (tag_mask, tag_value) = self.pick(&[
                (0, 0),
                (1, 1),
                (3, 2),
                (1, 1),
                (3, 1),
                (1, 2),
                (1 << 63, 1 << 63),
            ]);
            let since_revision = self.chance(0.3).then(|| v1::Revision {
                uid: self.uid(),
                number: self.revision / 2,
            });
            v1::Filter {
                tag_mask,
                tag_value,
                since_revision,
            }
        })
    }

    /// An existing revision, or the next one, for which no read waits.
    fn revision_or_none(&mut self) -> Option<v1::Revision> {
        let most = self.revision + 3;
        self.chance(0.8).then(|| v1::Revision {
            uid: self.uid(),
            number: self.random.random_range(0..=most),
        })
    }

    fn min_revision(&mut self) -> Option<v1::Revision> {
        self.chance(0.6).then(|| v1::Revision {
            uid: self.uid(),
            number: self.pick(&[0, self.revision, self.revision / 2]),
        })
    }

    fn uid(&mut self) -> String {
        let uid = if self.chance(0.97) { UID } else { "another" };
        if self.chance(0.8) { uid } else { "" }.to_owned()
    }

    fn index(&mut self) -> String {
        let name = if self.chance(0.97) { "arm" } else { "leg" };
        name.to_owned()
    }

    /// Draws one of a few ids, so that some come back, with another request or a twin.
    fn operation_id(&mut self) -> String {
        match self.random.random_range(0..20) {
            0 if self.chance(0.3) => "x".repeat(65),
            1..4 => format!("op-{}", self.random.random_range(0..12)),
            _ => String::new(),
        }
    }
}
