//! One run of a server, from its start to its end.

use rand::{RngExt, seq::IndexedRandom};
use wayfold_index::Space;
use wayfold_proto::v1;
use wayfold_server::service::{Code, RestoreCall, Service, Snapshot};

use super::expected::{Expected, Operation, TakenSnapshot, assert_holds, described};
use crate::{
    model::Model,
    random::{assert_same, compare, refused},
    support::snapshots::{settled, verification, verify},
    support::*,
    verify::hash_of,
};

const NAMES: [&str; 6] = ["arm", "eye", "hand", "leg", "rail", "wrist"];
const SPACES: [&str; 5] = ["R1", "SO2[1]", "R2*SO2", "R3*SO3:0.15", "sum(R2, SO3)"];
/// The maximum number of copies that are kept; a further one replaces another.
const COPIES: usize = 6;

pub(super) struct ServerRun<'a> {
    world: &'a mut Expected,
    service: Service,
    taking: Vec<SnapshotUnderWay>,
    restoring: Vec<RestoreUnderWay>,
}

/// A snapshot under way.
struct SnapshotUnderWay {
    snapshot: Snapshot,
    name: String,
    copied: TakenSnapshot,
}

/// A restore under way.
struct RestoreUnderWay {
    restoring: RestoreCall,
    name: String,
    copied: TakenSnapshot,
    sent: usize,
}

impl<'a> ServerRun<'a> {
    /// A run of `service`, which has just started.
    pub(super) async fn begin(world: &'a mut Expected, service: Service) -> Self {
        let mut life = Self {
            world,
            service,
            taking: Vec::new(),
            restoring: Vec::new(),
        };
        life.is_as_it_must().await;
        for name in life.world.indexes.keys().cloned().collect::<Vec<_>>() {
            life.verify(&name).await;
        }
        life
    }

    pub(super) async fn step(&mut self) {
        match self.world.random.random_range(0..32) {
            0..=2 => self.create().await,
            3..=4 => self.delete().await,
            5..=6 => self.begin_snapshot().await,
            7..=9 => self.go_on_with_a_snapshot().await,
            10..=11 => self.begin_restore(),
            12..=18 => self.go_on_with_a_restore().await,
            step => {
                let Some(name) = self.world.present() else {
                    return;
                };
                match step {
                    19..=21 => self.retry(&name).await,
                    22 => self.verify(&name).await,
                    _ => self.mutate(&name).await,
                }
            }
        }
        if let Some(name) = self.world.present() {
            let mut requests = self.world.requests(&name);
            let model = &self.world.indexes[&name].model;
            compare(&self.service, model, &mut requests).await;
        }
    }

    async fn create(&mut self) {
        let name = self.world.pick(&NAMES);
        let mut text = self.world.pick(&SPACES).to_owned();
        let held = self.world.indexes.get(name).map(|kept| &kept.model);
        if let Some(model) = held
            && self.world.random.random()
        {
            text = model.space.to_string();
        }
        let created = self
            .service
            .create_index(&CALL, creation_with_edges(name, &text));
        let created = created.await;
        let space: Space = text.parse().unwrap();
        let Some(model) = held else {
            let created = created.unwrap();
            assert!(created.created);
            let index = settled(created.index.unwrap());
            let model = Model::new(space, index.revision.uid());
            assert_eq!(index, described(name, &model));
            self.world.add(name, model);
            return;
        };
        if space == model.space {
            let found = created.unwrap();
            assert!(!found.created);
            assert_eq!(settled(found.index.unwrap()), described(name, model));
        } else {
            let (code, reason, _) = refusal(created);
            assert_eq!((code, reason), (Code::AlreadyExists, "INDEX_EXISTS"));
        }
    }

    async fn delete(&mut self) {
        let name = self.world.pick(&NAMES).to_owned();
        let held = self.world.indexes.get(&name).map(|kept| &kept.model);
        let uid = held.map_or(String::new(), |model| model.uid.clone());
        let requested = self.world.pick(&["", "another", &uid]).to_owned();
        let request = v1::DeleteIndexRequest {
            index_name: name.clone(),
            uid: requested.clone(),
        };
        let deleted = self.service.delete_index(&CALL, request).await;
        if !self.world.indexes.contains_key(&name) {
            assert_eq!(refusal(deleted).1, "INDEX_NOT_FOUND");
        } else if requested == "another" {
            assert_eq!(refusal(deleted).1, "UID_MISMATCH");
        } else {
            assert_eq!(deleted.unwrap().uid, uid);
            self.world.indexes.remove(&name);
        }
    }

    async fn mutate(&mut self, name: &str) {
        let mut requests = self.world.requests(name);
        let kept = self.world.indexes.get_mut(name).unwrap();
        // These ids occur in copies and in former states of the index too.
        let operation_id = format!("op {}", kept.operations.len());
        kept.operations.push(Operation {
            mutation: requests.mutation(kept.model.revision, operation_id),
            reply: None,
            changed: false,
        });
        let newest = kept.operations.len() - 1;
        self.send(name, newest).await;
    }

    async fn retry(&mut self, name: &str) {
        let operations = &self.world.indexes[name].operations;
        if operations.is_empty() {
            return;
        }
        let at = self.world.random.random_range(0..operations.len());
        if operations[at].reply.is_some() && self.world.random.random_bool(0.2) {
            let other = v1::RemoveRequest {
                index_name: name.into(),
                operation_id: format!("op {at}"),
                // No other request has this operation id.
                ..removal(&[1000])
            };
            let refused = refusal(self.service.remove(&CALL, other).await);
            assert_eq!(refused.1, "OPERATION_MISMATCH");
        }
        self.send(name, at).await;
    }

    /// Sends one of the index's operations.
    async fn send(&mut self, name: &str, at: usize) {
        let kept = self.world.indexes.get_mut(name).unwrap();
        let mutation = kept.operations[at].mutation.clone();
        let reply = refused(mutation.send(&self.service).await);
        assert_eq!(reply, kept.apply(at), "{mutation:?}");
    }

    async fn begin_snapshot(&mut self) {
        let any = self.world.pick(&NAMES);
        let name = match self.world.random.random_bool(0.8) {
            true => self.world.present().unwrap_or(any.into()),
            false => any.into(),
        };
        let request = v1::SnapshotIndexRequest {
            index_name: name.clone(),
            min_revision: None,
        };
        let begun = self.service.snapshot_index(&CALL, request).await;
        let Some(kept) = self.world.indexes.get(&name) else {
            assert_eq!(refusal(begun.map(drop)).1, "INDEX_NOT_FOUND");
            return;
        };
        self.taking.push(SnapshotUnderWay {
            snapshot: begun.unwrap(),
            name,
            copied: TakenSnapshot {
                parts: Vec::new(),
                model: kept.model.clone(),
            },
        });
    }

    async fn go_on_with_a_snapshot(&mut self) {
        if self.taking.is_empty() {
            return;
        }
        let at = self.world.random.random_range(0..self.taking.len());
        let taking = &mut self.taking[at];
        for _ in 0..self.world.random.random_range(1..=4) {
            if let Some(part) = taking.snapshot.next().await {
                taking.copied.parts.push(part.unwrap().part.unwrap());
                continue;
            }
            self.took(at);
            return;
        }
    }

    /// Keeps a complete snapshot.
    fn took(&mut self, at: usize) {
        let SnapshotUnderWay { name, copied, .. } = self.taking.swap_remove(at);
        assert_holds(&name, &copied.parts, &copied.model);
        if self.world.copies.len() < COPIES {
            self.world.copies.push(copied);
        } else {
            let at = self.world.random.random_range(0..COPIES);
            self.world.copies[at] = copied;
        }
    }

    fn begin_restore(&mut self) {
        let is_free = |name: &&str| !self.world.indexes.contains_key(*name);
        let free: Vec<&str> = NAMES.into_iter().filter(is_free).collect();
        let name = match free.is_empty() || self.world.random.random_bool(0.2) {
            true => self.world.pick(&NAMES),
            false => self.world.pick(&free),
        };
        let Expected { copies, random, .. } = &mut *self.world;
        if let Some(copied) = copies.choose(random) {
            self.restoring.push(RestoreUnderWay {
                restoring: self.service.restore_index(&CALL).unwrap(),
                name: name.into(),
                copied: copied.clone(),
                sent: 0,
            });
        }
    }

    async fn go_on_with_a_restore(&mut self) {
        if self.restoring.is_empty() {
            return;
        }
        let at = self.world.random.random_range(0..self.restoring.len());
        if self.world.random.random_bool(0.05) {
            self.restoring.swap_remove(at);
            return;
        }
        for _ in 0..self.world.random.random_range(1..=4) {
            let copying = &mut self.restoring[at];
            let Some(part) = copying.copied.parts.get(copying.sent) else {
                let copying = self.restoring.swap_remove(at);
                return self.finish(copying).await;
            };
            let message = v1::RestoreIndexRequest {
                name: copying.name.clone(),
                part: Some(part.clone()),
            };
            let added = copying.restoring.add(message).await;
            if copying.sent == 0 && self.world.indexes.contains_key(&copying.name) {
                assert_eq!(refusal(added).1, "INDEX_EXISTS");
                self.restoring.swap_remove(at);
                return;
            }
            added.unwrap();
            copying.sent += 1;
        }
    }

    async fn finish(&mut self, copying: RestoreUnderWay) {
        let RestoreUnderWay {
            restoring,
            name,
            copied,
            ..
        } = copying;
        let finished = restoring.finish().await;
        if self.world.indexes.contains_key(&name) {
            assert_eq!(refusal(finished).1, "INDEX_EXISTS");
            return;
        }
        let index = settled(finished.unwrap().index.unwrap());
        let model = Model {
            uid: index.revision.uid(),
            ..copied.model
        };
        assert_eq!(index, described(&name, &model));
        self.world.add(&name, model);
        self.world.restored += 1;
        self.verify(&name).await;
    }

    async fn verify(&mut self, name: &str) {
        let request = v1::VerifyIndexRequest {
            index_name: name.into(),
            query_count: Some(8),
            seed: self.world.random.random(),
            ..verification()
        };
        let report = verify(&self.service, request).await.unwrap();
        assert_eq!(report.first_disagreements, Vec::<String>::new());
        assert_eq!(report.disagreement_count, 0);
        let model = &self.world.indexes[name].model;
        assert_eq!(report.stored_point_count, model.points.len() as u64);
        let points = model.scan(&scanning()).points.unwrap();
        let expected = hash_of(&points, &model.space.to_string());
        assert_eq!(report.content_hash, expected);
    }

    /// Asserts that the server holds exactly the expected content.
    pub(super) async fn is_as_it_must(&mut self) {
        let expected = self.world.indexes.iter();
        let expected: Vec<_> = expected
            .map(|(name, kept)| described(name, &kept.model))
            .collect();
        assert_eq!(self.listed().await, expected);
        for index in expected {
            let name = index.name.clone();
            assert_eq!(settled(info(&self.service, &name).await), index);
            let mut requests = self.world.requests(&name);
            let model = &self.world.indexes[&name].model;

            let request = v1::ScanRequest {
                index_name: name.clone(),
                ..scanning()
            };
            let mut scan = self.service.scan(&CALL, request.clone()).await.unwrap();
            let all = scan.next().await.unwrap();
            assert_same(all, Ok(model.scan(&request)), &name);
            assert!(scan.next().await.is_none());

            let include = v1::Include {
                with_states: true,
                with_tags: true,
                with_revisions: true,
                with_payloads: true,
            };
            let knn = v1::KnnRequest {
                k_form: nearest(1000).map(Into::into),
                radius_form: None,
                filter: None,
                include: Some(include),
                ..requests.knn(model.revision)
            };
            let nearest = self.service.knn(&CALL, knn.clone()).await;
            assert_same(nearest, Ok(model.knn(&knn)), &name);
        }
    }

    /// All indices, read in pages of two, without their memory.
    async fn listed(&self) -> Vec<v1::Index> {
        let mut listed = Vec::new();
        let mut page_token = String::new();
        for _ in 0..=NAMES.len() {
            let request = v1::ListIndexesRequest {
                page_size: 2,
                page_token,
            };
            let page = self.service.list_indexes(&CALL, request).await.unwrap();
            listed.extend(page.indexes.into_iter().map(settled));
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return listed;
            }
        }
        panic!("more pages than indices: {listed:?}");
    }
}
