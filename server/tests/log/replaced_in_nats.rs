//! A journal in NATS that has other records in the place of those that a server has applied.

use std::sync::Arc;

use wayfold_server::log::{Log, LogError, Record, RecordPosition, RecordStream, Uid};

use crate::{effects, nats::Nats, next};

/// Submits the record after `position`, which stores a point with this id.
fn publish(nats: &Nats, log: &Log, uid: Uid, position: RecordPosition, id: u64) -> Arc<Record> {
    let effects = effects(position.revision + 1, &[id], &[]);
    let record = Arc::new(Record::after(position, effects));
    nats.publish(log, uid, &record);
    record
}

/// The stream of a server that has applied `applied`.
fn followed(nats: &Nats, log: &Log, uid: Uid, applied: RecordPosition) -> RecordStream {
    let _entered = nats.runtime.enter();
    log.journal.follow_applied(uid, applied)
}

#[ignore = "needs nats-server"]
#[test]
fn a_follower_compares_the_newest_record_in_nats() {
    let (nats, uid) = (Nats::start(), Uid::unique());
    let log = nats.connect(Arc::default());
    let mut position = RecordPosition::START;
    for id in 0..3 {
        position = publish(&nats, &log, uid, position, id).position();
    }
    let other = RecordPosition {
        digest: [7; 32],
        ..position
    };
    let refused = next(&mut followed(&nats, &log, uid, other)).unwrap_err();
    let LogError::JournalDamaged { revision, what, .. } = refused else {
        panic!("{refused}");
    };
    assert_eq!(
        (revision, what),
        (3, "the journal has another one in its place")
    );

    // One that has applied the newest record gets the next one.
    let mut equal = followed(&nats, &log, uid, position);
    let fourth = publish(&nats, &log, uid, position, 3);
    assert_eq!(next(&mut equal).unwrap(), [fourth]);
    // The fourth names the third, so one that has applied another third notices it by that.
    let behind = next(&mut followed(&nats, &log, uid, other)).unwrap();
    assert!(!behind[0].follows(other));
}
