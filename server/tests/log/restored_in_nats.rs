//! An index whose journal in NATS begins at an origin, and its name.

use std::sync::Arc;

use tokio::runtime::{Builder, Runtime};
use wayfold_server::log::{
    Catalogue, Entry, Log, LogError, MemoryLog, Record, Tip, Uid, connect_nats,
};

use crate::{effects, entry, nats::NatsServer};

const ORIGIN: Tip = Tip {
    revision: 7,
    digest: [5; 32],
};

fn connect(runtime: &Runtime, server: &NatsServer, entries: &[&Entry]) -> Log {
    let local = Arc::new(MemoryLog::new());
    for entry in entries {
        local.create(Entry::clone(entry)).unwrap();
    }
    let _entered = runtime.enter();
    connect_nats(&server.options(), local).unwrap().0
}

fn first(id: u64) -> Arc<Record> {
    let effects = effects(ORIGIN.revision + 1, &[id], &[]);
    Arc::new(Record::after(ORIGIN, effects))
}

#[ignore = "needs nats-server"]
#[test]
fn a_journal_that_begins_at_an_origin_is_trimmed_for_others_in_nats() {
    let (server, entry) = (NatsServer::start(), entry("arm"));
    let uid = entry.uid;
    let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
    let [log, other] = [(), ()].map(|()| connect(&runtime, &server, &[&entry]));
    let record = first(1);
    log.journal.begin(uid, Arc::clone(&record)).unwrap();
    let fenced = other.journal.begin(uid, first(2)).unwrap_err();
    assert!(
        matches!(fenced, LogError::Fenced { head: 8, .. }),
        "{fenced}"
    );
    let trimmed = LogError::Trimmed {
        uid,
        after: 0,
        oldest: ORIGIN.revision,
    };
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
    let server = NatsServer::start();
    let runtime = Builder::new_multi_thread().enable_all().build().unwrap();
    let [one, two, three] = [(), (), ()].map(|()| entry("arm"));
    // The point stores have what was restored, and a crash may leave it there without a name.
    let [log, other] = [&one, &two].map(|entry| connect(&runtime, &server, &[entry]));
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
    let later = connect(&runtime, &server, &[]);
    assert_eq!(named(&*later.catalogue), [three.uid]);
    // Nobody takes it from the new one in the name of the old one, or of none.
    for replaced in [None, Some(one.uid), Some(two.uid)] {
        let again = log.catalogue.claim(&two, replaced);
        let taken = LogError::NameTaken { name: "arm".into() };
        assert_eq!(again, Err(taken), "{replaced:?}");
    }
    assert_eq!(named(&*later.catalogue), [three.uid]);
}
