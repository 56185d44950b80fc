//! A journal in NATS that has other records in the place of those that a server has applied.

use std::sync::Arc;

use tokio::runtime::{Builder, Runtime};
use wayfold_server::log::{
    Journal, Log, LogError, MemoryLog, Receipt, Record, RecordPosition, RecordStream, Uid,
    connect_nats,
};

use crate::{effects, nats::NatsServer, next};

/// Submits the record after `position`, which stores a point with this id.
fn publish(
    runtime: &Runtime,
    journal: &dyn Journal,
    uid: Uid,
    position: RecordPosition,
    id: u64,
) -> Arc<Record> {
    let record = Arc::new(Record::after(
        position,
        effects(position.revision + 1, &[id], &[]),
    ));
    let Receipt::Awaited(receipt) = journal.submit(uid, Arc::clone(&record)).unwrap() else {
        panic!("a journal elsewhere accepts nothing at once");
    };
    runtime.block_on(receipt).unwrap();
    record
}

/// The stream of a server that has applied `applied`.
fn followed(runtime: &Runtime, log: &Log, uid: Uid, applied: RecordPosition) -> RecordStream {
    let _entered = runtime.enter();
    log.journal.follow_applied(uid, applied)
}

#[ignore = "needs nats-server"]
#[test]
fn a_follower_compares_the_newest_record_in_nats() {
    let (server, uid) = (NatsServer::start(), Uid::unique());
    let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
    let log = {
        let _entered = runtime.enter();
        let connected = connect_nats(&server.options(), Arc::new(MemoryLog::new()));
        connected.unwrap().0
    };
    let journal = &*log.journal;
    let mut position = RecordPosition::START;
    for id in 0..3 {
        position = publish(&runtime, journal, uid, position, id).position();
    }
    let other = RecordPosition {
        digest: [7; 32],
        ..position
    };
    let refused = next(&mut followed(&runtime, &log, uid, other)).unwrap_err();
    let LogError::JournalDamaged { revision, what, .. } = refused else {
        panic!("{refused}");
    };
    assert_eq!(
        (revision, what),
        (3, "the journal has another one in its place")
    );

    // One that has applied the newest record gets the next one.
    let mut equal = followed(&runtime, &log, uid, position);
    let fourth = publish(&runtime, journal, uid, position, 3);
    assert_eq!(next(&mut equal).unwrap(), [fourth]);
    // The fourth names the third, so one that has applied another third notices it by that.
    let behind = next(&mut followed(&runtime, &log, uid, other)).unwrap();
    assert!(!behind[0].follows(other));
}
