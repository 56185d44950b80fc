//! Creates and deletes indices.

use std::collections::BTreeMap;

use tokio::sync::watch;
use wayfold_proto::v1::{
    CreateIndexRequest, DeleteIndexRequest, ListIndexesRequest, create_index_request::SpaceForm,
};
use wayfold_tests::{Stubs, insert_request};

/// A client that creates and deletes indices. The state of the last one may be unknown to it.
#[derive(Default)]
pub(crate) struct Builder {
    calls: u64,
    /// The number of points of each known index; None for a deleted one.
    known: BTreeMap<String, Option<u64>>,
}

impl Builder {
    /// Runs until the server is gone, and signals the begin of each call.
    pub(crate) async fn build(mut self, mut stubs: Stubs, began: watch::Sender<u64>) -> Self {
        loop {
            self.calls += 1;
            let name = format!("scratch-{}", self.calls % 5);
            let there = self.known.remove(&name).flatten().is_some();
            began.send_modify(|count| *count += 1);
            let done = if there {
                let request = DeleteIndexRequest {
                    index_name: name.clone(),
                    ..Default::default()
                };
                stubs.indexes.delete_index(request).await.is_ok()
            } else {
                let request = CreateIndexRequest {
                    name: name.clone(),
                    space_form: Some(SpaceForm::SpaceText("R2".into())),
                    ..Default::default()
                };
                let created = stubs.indexes.create_index(request).await.is_ok();
                let row = insert_request(&name, &[1.0, 2.0], 2);
                created && stubs.points.insert(row).await.is_ok()
            };
            if !done {
                return self;
            }
            self.known.insert(name, (!there).then_some(1));
        }
    }

    /// Checks that each acknowledged change took effect, and each unknown one entirely or not at all.
    pub(crate) async fn check(&mut self, stubs: &mut Stubs) {
        let request = ListIndexesRequest::default();
        let listed = stubs.indexes.list_indexes(request).await.unwrap();
        let listed = listed.into_inner().indexes;
        let listed = listed.into_iter().filter(|index| index.name != "arm");
        let listed: BTreeMap<_, _> = listed
            .map(|index| (index.name, index.point_count))
            .collect();
        for (name, points) in &self.known {
            assert_eq!(listed.get(name), points.as_ref(), "{name}");
        }
        for (name, &points) in &listed {
            assert!(points <= 1, "{name} has {points} points");
        }
        let listed = listed.into_iter();
        self.known = listed.map(|(name, points)| (name, Some(points))).collect();
    }
}
