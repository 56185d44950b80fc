//! A client that follows an index by its publications, and asks the log for missed mutations.

use std::collections::BTreeMap;

use prost::Message;
use wayfold_proto::v1;
use wayfold_tests::{Content, INCLUDE_ALL, StoredPoint, bits, number, revision};
use zenoh::bytes::Encoding;

use crate::robot::Robot;

/// The follower's knowledge of the index "arm".
pub(crate) struct Follower<'a> {
    robot: &'a Robot,
    pub(crate) content: Content,
    /// The mutations, each whole.
    pub(crate) mutations: Vec<v1::Mutation>,
    /// The pieces of the next one.
    pieces: Vec<v1::Mutation>,
    /// The number of times it asked the log for missed mutations.
    pub(crate) repairs: usize,
}

impl<'a> Follower<'a> {
    /// A follower that knows the index from its beginning.
    pub(crate) fn new(robot: &'a Robot, uid: &str) -> Self {
        let content = Content {
            uid: uid.to_owned(),
            revision: 0,
            points: BTreeMap::new(),
        };
        Self {
            robot,
            content,
            mutations: Vec::new(),
            pieces: Vec::new(),
            repairs: 0,
        }
    }

    /// Takes a publication, and asks for the mutations that it shows to be missing.
    pub(crate) async fn take(&mut self, response: v1::WatchResponse) {
        let newest = response.revision.unwrap();
        assert_eq!(newest.uid, self.content.uid);
        assert_eq!(response.reset, None);
        let expected = match self.pieces.last() {
            Some(last) => (number(&last.revision), last.piece + 1),
            None => (self.content.revision + 1, 0),
        };
        let first = response.mutations.first();
        match first.map(|first| (number(&first.revision), first.piece)) {
            Some(first) if first > expected => {
                // The follower missed earlier pieces of this mutation, so it asks for all of it.
                let before = first.0 - u64::from(first.1 == 0);
                self.repair(before).await;
            }
            Some(_) => {}
            None => self.repair(newest.number).await,
        }
        for mutation in response.mutations {
            self.apply(mutation);
        }
    }

    /// Asks the log up to a revision.
    pub(crate) async fn repair(&mut self, to: u64) {
        self.pieces.clear();
        while self.content.revision < to {
            let response = self.log().await;
            assert_eq!(response.reset, None);
            assert!(!response.mutations.is_empty());
            self.repairs += 1;
            for mutation in response.mutations {
                self.apply(mutation);
            }
        }
    }

    /// The log's mutations after the newest known revision.
    pub(crate) async fn log(&self) -> v1::WatchResponse {
        let request = v1::WatchRequest {
            after_revision: revision(&self.content.uid, self.content.revision),
            include: Some(INCLUDE_ALL),
            ..Default::default()
        };
        let payload = request.encode_to_vec();
        let response = self.robot.ask(
            "wayfold/v1/arm/log",
            payload,
            Encoding::APPLICATION_PROTOBUF,
        );
        v1::WatchResponse::decode(&*response.await.unwrap().payload).unwrap()
    }

    fn apply(&mut self, mutation: v1::Mutation) {
        // After a repair, a mutation from the log may be published once more.
        let made = number(&mutation.revision);
        if made <= self.content.revision {
            return;
        }
        assert_eq!(
            mutation.revision,
            revision(&self.content.uid, self.content.revision + 1)
        );
        let continued = mutation.continued;
        self.pieces.push(mutation);
        if continued {
            return;
        }
        self.content.revision += 1;
        let pieces = std::mem::take(&mut self.pieces);
        for piece in &pieces {
            for id in &piece.removed_ids {
                assert!(self.content.points.remove(id).is_some());
            }
            if let Some(stored) = &piece.stored {
                self.store(stored);
            }
        }
        self.mutations.extend(pieces);
    }

    fn store(&mut self, stored: &v1::Points) {
        let states = stored.states.as_ref().unwrap();
        let rows = states
            .coordinates
            .chunks(states.coordinates.len() / states.row_count as usize);
        for (slot, row) in rows.enumerate() {
            let point = StoredPoint {
                state: bits(row),
                tag: stored.tags[slot],
                revision: stored.revisions[slot],
                payload: stored.payloads[slot].to_vec(),
            };
            self.content.points.insert(stored.ids[slot], point);
        }
    }
}
