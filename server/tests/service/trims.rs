//! An index that keeps no history loses no write of those that are under way while it forgets.

use std::{collections::BTreeSet, sync::Arc};

use wayfold_server::{log::MemoryLog, registry::RegistryOptions, service::Limits};

use crate::support::*;

const WRITERS: u32 = 8;
const CALLS: u32 = 50;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn writers_go_on_while_every_record_is_forgotten() {
    let options = RegistryOptions {
        window_bytes: 0,
        ..options()
    };
    let service = restarted_with(Arc::new(MemoryLog::new()), options, Limits::default());
    create(&service, "arm", "R1").await;
    let writers = (0..WRITERS).map(|writer| {
        let service = service.clone();
        tokio::spawn(async move {
            let mut ids = Vec::new();
            for call in 0..CALLS {
                let request = insertion(&[[f64::from(writer * CALLS + call)]], &[]);
                ids.extend(service.insert(&CALL, request).await.unwrap().ids);
            }
            ids
        })
    });
    let mut ids = BTreeSet::new();
    for writer in writers.collect::<Vec<_>>() {
        ids.extend(writer.await.unwrap());
    }
    assert_eq!(ids.len() as u32, WRITERS * CALLS);
    let found = everything(&service).await.points.unwrap();
    assert_eq!(found.ids, Vec::from_iter(ids));
}
