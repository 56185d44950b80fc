//! The figures of an index while its records, batches and subscribers are under way.

use futures_util::{StreamExt, stream};

use super::*;
use crate::{
    log::{Journal, LogError, RecordStream, Uid},
    registry::IndexState,
    testing::{forward_journal, recorded, server},
};

/// A shared journal that takes every record and sends none.
struct Silent {
    local: Arc<MemoryLog>,
}

impl Journal for Silent {
    forward_journal!(local);

    fn follow(&self, _: Uid, _: u64) -> RecordStream {
        stream::pending().boxed()
    }

    fn newest(&self, uid: Uid) -> Result<u64, LogError> {
        self.local.newest(uid)
    }
}

fn insertion() -> v1::InsertRequest {
    let states = v1::States {
        row_count: 1,
        coordinates: vec![0.5],
    };
    v1::InsertRequest {
        index_name: "arm".into(),
        states: Some(states),
        ..Default::default()
    }
}

#[tokio::test]
async fn what_is_under_way_is_counted() {
    const RECORDS: u64 = 9;
    let local = recorded(RECORDS);
    let journal = Silent {
        local: Arc::clone(&local),
    };
    let service = server(&Arc::new(journal), &local);
    let Some((_, IndexState::Hosted(hosted))) = service.listed().into_iter().next() else {
        panic!("an index");
    };
    let _subscribers = [RECORDS, 2].map(|revision| hosted.subscribers.join(revision));
    let _batches = [(); 3].map(|()| Arc::clone(&hosted.batches));
    for _ in 0..4 {
        let (service, request) = (service.clone(), insertion());
        tokio::spawn(async move { service.insert(&Call::default(), request).await });
    }
    while hosted.records_in_flight() < 4 {
        tokio::task::yield_now().await;
    }
    let Pages { shared, phases, .. } = pages(&service, Identities::default());
    let metrics = shared.metrics.clone();
    metrics.add(MetricsCollector { shared, phases });
    let text = metrics.text().unwrap();
    for (name, figure) in [
        ("records_in_flight", 4),
        ("batches", 3),
        ("subscribers", 2),
        ("subscriber_lag", 7),
        ("revision", RECORDS),
    ] {
        let line = format!("wayfold_index_{name}{{index=\"arm\"}} {figure}\n");
        assert!(text.contains(&line), "{line} in {text}");
    }
}
