//! An index whose journal in NATS begins at an origin, and its name.

use std::{sync::Arc, thread, time::UNIX_EPOCH};

use wayfold_server::log::{
    Catalogue, Entry, Journal, Log, LogError, MemoryLog, Origin, PointStore, Record,
    RecordPosition, Retention, Sessions, Uid,
};

use crate::{effects, entry, nats::Nats};

const ORIGIN: RecordPosition = RecordPosition {
    revision: 7,
    digest: [5; 32],
};

fn connect(nats: &Nats, entries: &[&Entry]) -> Log {
    let local = Arc::new(MemoryLog::new());
    for entry in entries {
        local.create(Entry::clone(entry)).unwrap();
    }
    nats.connect(local)
}

fn first(id: u64) -> Arc<Record> {
    let effects = effects(ORIGIN.revision + 1, &[id], &[]);
    Arc::new(Record::after(ORIGIN, effects))
}

#[ignore = "needs nats-server"]
#[test]
fn a_journal_that_begins_at_an_origin_is_trimmed_for_others_in_nats() {
    let (nats, entry) = (Nats::start(), entry("arm"));
    let uid = entry.uid;
    let [log, other] = [(), ()].map(|()| connect(&nats, &[&entry]));
    let record = first(1);
    log.journal.begin(uid, Arc::clone(&record)).unwrap();
    let fenced = other.journal.begin(uid, first(2)).unwrap_err();
    assert!(
        matches!(fenced, LogError::Fenced { head: 8, .. }),
        "{fenced}"
    );
    let trimmed = LogError::trimmed(uid, 0, ORIGIN.revision);
    assert_eq!(other.journal.read(uid, Some(0), 1), Err(trimmed));
    let after = other.journal.read(uid, Some(ORIGIN.revision), 1).unwrap();
    assert_eq!(after, [record]);
    // A trim leaves the newest message, so the origin is never passed.
    log.journal.forget(uid, u64::MAX).unwrap();
    assert_eq!(log.journal.oldest(uid), Ok(Some(ORIGIN.revision + 1)));
}

#[ignore = "needs nats-server"]
#[test]
fn one_of_two_servers_gets_a_name_in_nats() {
    let nats = Nats::start();
    let [one, two, three] = [(), (), ()].map(|()| entry("arm"));
    // The point stores have what was restored, and a crash may leave it there without a name.
    let [log, other] = [&one, &two].map(|entry| connect(&nats, &[entry]));
    let named = |catalogue: &dyn Catalogue| -> Vec<Uid> {
        let entries = catalogue.indexes().unwrap();
        entries.iter().map(|entry: &Entry| entry.uid).collect()
    };
    assert_eq!(
        (named(&*log.catalogue), named(&*other.catalogue)),
        (vec![], vec![])
    );
    log.catalogue.claim(&one, None).unwrap();
    let taken = LogError::NameTaken { name: "arm".into() };
    assert_eq!(other.catalogue.claim(&two, None), Err(taken));
    assert_eq!(named(&*other.catalogue), [one.uid]);

    // A new generation takes it, and the server that has the old one deletes that.
    other.catalogue.claim(&three, Some(one.uid)).unwrap();
    let later = connect(&nats, &[]);
    assert_eq!(named(&*later.catalogue), [three.uid]);
    // Nobody takes it from the new one in the name of the old one, or of none.
    for replaced in [None, Some(one.uid), Some(two.uid)] {
        let again = log.catalogue.claim(&two, replaced);
        let taken = LogError::NameTaken { name: "arm".into() };
        assert_eq!(again, Err(taken), "{replaced:?}");
    }
    assert_eq!(named(&*later.catalogue), [three.uid]);
}

/// Each round another server has more of the records that NATS has lost.
#[ignore = "needs nats-server"]
#[test]
fn a_journal_that_nats_has_lost_whole_begins_again_once_in_nats() {
    const RECORDS: u64 = 3;
    let (nats, entry) = (Nats::start(), entry("arm"));
    let uid = entry.uid;
    let mut records = vec![first(1)];
    for id in 2..=RECORDS {
        let position = records[records.len() - 1].position();
        let effects = effects(position.revision + 1, &[id], &[]);
        records.push(Arc::new(Record::after(position, effects)));
    }
    let newest = ORIGIN.revision + RECORDS;
    let logs: Vec<Log> = [RECORDS, 1]
        .map(|kept| {
            let local = Arc::new(MemoryLog::new());
            let origin = Origin {
                revision: ORIGIN.revision,
                next_id: 1,
                digest: ORIGIN.digest,
            };
            let restoring = local.restore(entry.clone(), origin, false).unwrap();
            restoring.finish(Sessions::default(), vec![]).unwrap();
            for record in &records {
                local.submit(uid, Arc::clone(record)).unwrap();
            }
            local.apply(uid, &records).unwrap();
            if kept < RECORDS {
                let retention = Retention {
                    record_bytes: 0,
                    since: UNIX_EPOCH,
                    operations: usize::MAX,
                    operation_bytes: usize::MAX,
                };
                local.trim(uid, &retention).unwrap();
            }
            assert_eq!(local.oldest(uid), Ok(Some(newest + 1 - kept)));
            nats.connect(local)
        })
        .into();
    for _ in 0..10 {
        // It forgets the messages, as the loss of a store does.
        let lost = connect(&nats, &[&entry]);
        lost.catalogue.delete(uid).unwrap();
        assert_eq!(lost.journal.newest(uid), Ok(0));
        let repaired: Vec<_> = thread::scope(|scope| {
            let repairing: Vec<_> = logs
                .iter()
                .map(|log| scope.spawn(|| log.journal.repair(uid)))
                .collect();
            let repaired = repairing.into_iter().map(|it| it.join().unwrap());
            repaired.collect()
        });
        assert!(repaired.iter().any(Result::is_ok), "{repaired:?}");
        let other = &lost.journal;
        let oldest = other.oldest(uid).unwrap().unwrap();
        assert!([ORIGIN.revision + 1, newest].contains(&oldest), "{oldest}");
        let found = other.read(uid, Some(oldest - 1), usize::MAX).unwrap();
        assert_eq!(found, records[(oldest - ORIGIN.revision - 1) as usize..]);
        // A server without the points does not take the index for an empty one.
        let trimmed = other.read(uid, Some(0), 1).unwrap_err();
        assert!(matches!(trimmed, LogError::Trimmed { .. }), "{trimmed}");
        for log in &logs {
            assert_eq!(log.journal.repair(uid), Ok(0));
        }
    }
}
