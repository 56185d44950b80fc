//! A record that takes several messages of NATS, each as large as NATS allows.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use futures_util::StreamExt;
use tokio::time::timeout;
use wayfold_index::PointRef;
use wayfold_server::log::{Effects, Outcome, Record, RecordPosition, Uid};

use crate::nats::{Nats, NatsServer};

const MAX_PAYLOAD: usize = 2 * 1024 * 1024;
const MAX_WAIT: Duration = Duration::from_secs(30);

#[ignore = "needs nats-server"]
#[test]
fn a_follower_gets_messages_of_the_largest_size() {
    let server = NatsServer::start_with(&format!("max_payload: {MAX_PAYLOAD}"));
    let nats = Nats::of(server);
    let log = nats.connect(Arc::default());
    let uid = Uid::unique();
    let mut effects = Effects::new(1);
    let point = PointRef {
        id: 1,
        tag: 0,
        revision: 1,
        row: &[0.0],
    };
    let payload = Bytes::from(vec![7; MAX_PAYLOAD]);
    effects.store(point, Outcome::Inserted, payload);
    let record = Arc::new(Record::after(RecordPosition::START, effects));
    nats.publish(&log, uid, &record);
    nats.runtime.block_on(async {
        let mut records = log.journal.follow(uid, 0);
        let found = timeout(MAX_WAIT, records.next()).await;
        assert!(found.expect("no record").unwrap().unwrap() == [record]);
    });
}
