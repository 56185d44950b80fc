//! The records that a shared journal forgets.

use std::sync::Arc;

use bytes::Bytes;
use wayfold_index::PointRef;
use wayfold_server::log::{
    Catalogue, Effects, LogError, MemoryLog, Outcome, Record, RecordPosition,
};

use crate::{entry, nats::Nats, next, retention};

/// Whole messages go, none that has a later record, and never the newest one.
#[ignore = "needs nats-server"]
#[test]
fn whole_packs_are_forgotten_in_nats() {
    const RECORDS: u64 = 12;
    let (nats, entry) = (Nats::start(), entry("arm"));
    let uid = entry.uid;
    let local = Arc::new(MemoryLog::new());
    let log = nats.connect(Arc::clone(&local));
    local.create(entry).unwrap();
    let mut position = RecordPosition::START;
    let mut records = Vec::new();
    for revision in 1..=RECORDS {
        let mut effects = Effects::new(1);
        let point = PointRef {
            id: revision,
            tag: 0,
            revision,
            row: &[0.5],
        };
        // Every third takes several messages.
        let bytes = if revision % 3 == 0 { 3000 } else { 10 };
        effects.store(point, Outcome::Inserted, Bytes::from(vec![1; bytes]));
        let record = Arc::new(Record::after(position, effects));
        position = record.position();
        nats.publish(&log, uid, &record);
        records.push(record);
    }
    let oldest = || match log.journal.read(uid, Some(0), 1) {
        Err(LogError::Trimmed { oldest, .. }) => oldest,
        read => {
            assert_eq!(read.unwrap()[0].revision(), 1);
            0
        }
    };
    log.points.apply(uid, &records).unwrap();
    // This server keeps them all.
    log.journal.forget(uid, RECORDS).unwrap();
    assert_eq!(oldest(), 0);

    log.points.trim(uid, &retention(0)).unwrap();
    for up_to in 1..RECORDS {
        log.journal.forget(uid, up_to).unwrap();
        assert_eq!(oldest(), up_to);
        let _entered = nats.runtime.enter();
        let followed = next(&mut log.journal.follow(uid, up_to)).unwrap();
        assert_eq!(followed[0].position(), records[up_to as usize].position());
    }
    log.journal.forget(uid, RECORDS).unwrap();
    assert_eq!(oldest(), RECORDS - 1);
    // The next record follows it.
    let record = Arc::new(Record::after(position, Effects::new(1)));
    nats.publish(&log, uid, &record);
}
