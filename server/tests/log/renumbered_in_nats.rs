//! A NATS that has lost its newest messages, and gives their sequence numbers to others.

use std::{
    sync::{Arc, atomic::Ordering::Relaxed},
    time::Duration,
};

use futures_util::{StreamExt, TryStreamExt};
use tokio::{task::yield_now, time::timeout};
use wayfold_server::log::{Log, LogError, MemoryLog, Record, RecordPosition, Uid, connect_nats};

use crate::{
    effects,
    nats::{Nats, NatsServer},
};

const MAX_WAIT: Duration = Duration::from_secs(60);

/// A NATS that takes each of these records as one message.
fn start() -> Nats {
    Nats::of(NatsServer::start_with(""))
}

fn after(before: RecordPosition, id: u64) -> Arc<Record> {
    let effects = effects(before.revision + 1, &[id], &[]);
    Arc::new(Record::after(before, effects))
}

/// Loses the records of all indices.
async fn lose(server: &NatsServer) {
    let client = async_nats::connect(server.options().servers).await.unwrap();
    let context = async_nats::jetstream::new(client);
    let names: Vec<String> = context.stream_names().try_collect().await.unwrap();
    for name in names.iter().filter(|name| name.contains("-log-")) {
        context.delete_stream(name).await.unwrap();
    }
}

/// Loses the record `lost`, the first of an index and published by `log`, and gives its sequence number to a record of another
/// server. Then `log` must refuse the record that follows the lost one.
fn check(nats: &Nats, log: &Log, uid: Uid, lost: &Record) {
    nats.runtime.block_on(lose(&nats.server));
    let other = nats.connect(Arc::default());
    let kept = after(RecordPosition::START, 8);
    nats.publish(&other, uid, &kept);
    let refused = nats.submit(log, uid, &after(lost.position(), 9));
    assert_eq!(refused, Err(LogError::fenced(uid, 1, 1)));
    assert_eq!(other.journal.read(uid, None, usize::MAX), Ok(vec![kept]));
}

#[ignore = "needs nats-server"]
#[test]
fn a_sequence_number_of_a_former_connection_is_not_expected_in_nats() {
    let (nats, uid) = (start(), Uid::unique());
    let (log, client) = {
        let _entered = nats.runtime.enter();
        connect_nats(&nats.server.options(), Arc::new(MemoryLog::new())).unwrap()
    };
    let lost = after(RecordPosition::START, 1);
    nats.publish(&log, uid, &lost);
    let statistics = client.statistics();
    let connects = statistics.connects.load(Relaxed);
    nats.runtime.block_on(async {
        client.force_reconnect().await.unwrap();
        let connected = async {
            while statistics.connects.load(Relaxed) == connects {
                yield_now().await;
            }
        };
        timeout(MAX_WAIT, connected).await.unwrap();
    });
    check(&nats, &log, uid, &lost);
}

#[ignore = "needs nats-server"]
#[test]
fn a_sequence_number_before_a_lost_acknowledgement_is_not_expected_in_nats() {
    let (nats, uid) = (start(), Uid::unique());
    let log = nats.connect(Arc::default());
    let lost = after(RecordPosition::START, 1);
    nats.publish(&log, uid, &lost);
    let late = after(lost.position(), 2);
    nats.server.signal("STOP");
    let unconfirmed = nats.submit(&log, uid, &late).unwrap_err();
    assert!(
        matches!(unconfirmed, LogError::Unconfirmed { .. }),
        "{unconfirmed}"
    );
    nats.server.signal("CONT");
    // NATS takes the record now, and must not take it after the loss.
    nats.runtime.block_on(async {
        let mut records = log.journal.follow(uid, 1);
        let arrived = timeout(MAX_WAIT, records.next()).await;
        assert_eq!(arrived.unwrap().unwrap(), Ok(vec![late]));
    });
    check(&nats, &log, uid, &lost);
}
