//! The names of indices that a server claims: NATS answers late, or another server has claimed or deleted them meanwhile.

use std::{slice::from_ref, sync::Arc};

use wayfold_server::log::{
    Catalogue, Entry, Log, LogError, MemoryLog, NatsOptions, Record, RecordPosition,
};

use crate::{
    effects, entry,
    nats::{Nats, NatsServer},
};

/// A user that gets answers, but no message of a subscription: its server learns of other servers' changes late.
const BLIND: &str = "no_auth_user: any
authorization { users: [
    { user: any, password: any },
    { user: blind, password: any, permissions: { subscribe: { deny: \"_INBOX.*\" } } },
] }";

/// A log that learns of changes late, and another one.
fn blind_and_other() -> (Nats, [Log; 2]) {
    let nats = Nats::of(NatsServer::start_with(BLIND));
    let options = nats.server.options();
    let blind = NatsOptions {
        servers: options.servers.replace("nats://", "nats://blind:any@"),
        ..options.clone()
    };
    let logs = [blind, options].map(|options| nats.connect_with(&options, Arc::default()));
    (nats, logs)
}

#[ignore = "needs nats-server"]
#[test]
fn a_name_that_another_server_has_given_and_taken_back_is_free() {
    let (nats, [log, other]) = blind_and_other();
    let [first, second] = [(), ()].map(|()| entry("arm"));
    other.catalogue.create(first.clone()).unwrap();
    other.catalogue.delete(first.uid).unwrap();
    log.catalogue.create(second.clone()).unwrap();
    nats.until(&other, |it| it.indexes().unwrap() == from_ref(&second));
}

#[ignore = "needs nats-server"]
#[test]
fn a_repeated_claim_leaves_an_index_whose_claim_was_taken_late() {
    let (nats, [log, other]) = blind_and_other();
    let [first, second] = [(), ()].map(|()| entry("arm"));

    nats.server.signal("STOP");
    let unanswered = log.catalogue.create(first.clone()).unwrap_err();
    assert!(
        matches!(unanswered, LogError::Unreachable { .. }),
        "{unanswered}"
    );
    nats.server.signal("CONT");
    nats.until(&other, |it| it.indexes().unwrap() == from_ref(&first));

    let taken = LogError::NameTaken { name: "arm".into() };
    assert_eq!(log.catalogue.create(second), Err(taken));
    for log in [&log, &other] {
        assert_eq!(log.catalogue.indexes().unwrap(), from_ref(&first));
    }
}

/// A delete purges the records, which looks as if NATS had lost them.
#[ignore = "needs nats-server"]
#[test]
fn a_server_that_learns_late_of_a_delete_publishes_no_record_again_in_nats() {
    let (nats, [log, other]) = blind_and_other();
    let entry = entry("arm");
    let uid = entry.uid;
    log.catalogue.create(entry.clone()).unwrap();
    let record = Record::after(RecordPosition::START, effects(1, &[1], &[]));
    let record = Arc::new(record);
    nats.publish(&log, uid, &record);
    log.points.submit(uid, Arc::clone(&record)).unwrap();
    log.points.apply(uid, from_ref(&record)).unwrap();
    nats.until(&other, |it| it.indexes().unwrap() == from_ref(&entry));
    other.catalogue.delete(uid).unwrap();

    assert_eq!(log.journal.repair(uid), Err(LogError::UnknownIndex { uid }));
    assert_eq!(other.journal.newest(uid), Ok(0));
    // It has learnt of the delete by that.
    assert!(log.catalogue.indexes().unwrap().is_empty());
}

/// A purge may take seconds, and creates may get no answer any number of times.
#[ignore = "needs nats-server"]
#[test]
fn only_a_restored_index_is_removed_after_a_claim_without_an_answer_in_nats() {
    let nats = Nats::start();
    // NATS refuses a message as large as this space.
    let factors: Vec<_> = (1..=200).map(|weight| format!("SO2:{weight}.5")).collect();
    for is_restored in [false, true] {
        let name = format!("restored {is_restored}");
        let (claimed, local) = (entry(&name), Arc::new(MemoryLog::new()));
        let unanswered = Entry {
            space: factors.join("*").parse().unwrap(),
            ..entry(&name)
        };
        if is_restored {
            local.create(unanswered.clone()).unwrap();
        }
        let log = nats.connect(Arc::clone(&local));
        let record = Record::after(RecordPosition::START, effects(1, &[1], &[]));
        log.journal.begin(unanswered.uid, Arc::new(record)).unwrap();
        let failed = log.catalogue.claim(&unanswered, None).unwrap_err();
        assert!(matches!(failed, LogError::Unreachable { .. }), "{failed}");
        log.catalogue.claim(&claimed, None).unwrap();
        // A purge takes its record too.
        let kept = u64::from(!is_restored);
        assert_eq!(log.journal.newest(unanswered.uid), Ok(kept));
        assert!(local.indexes().unwrap().is_empty());
    }
}
