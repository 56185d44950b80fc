//! Damage to the content of a store, as recovery finds it.

use bytes::Bytes;
use wayfold_index::PointRef;

use super::{
    super::{Durability, layout::point_key, point, store::Store},
    *,
};
use crate::log::{Effects, Outcome, Record};

/// The effects of the revision after `head`: they store a point, change one, and remove another.
fn effects(head: u64) -> Effects {
    let mut effects = Effects::new(1);
    for id in [2 * head, 1] {
        let point = PointRef {
            id,
            tag: head,
            revision: head + 1,
            row: &[0.5],
        };
        let outcome = match id == 1 && head > 0 {
            true => Outcome::Replaced,
            false => Outcome::Inserted,
        };
        effects.store(point, outcome, Bytes::from_static(b"grasp"));
    }
    if head > 0 {
        effects.remove(2 * (head - 1));
    }
    effects
}

/// The damage that is found in an index of three records after `damage`; None if none is found.
fn found(damage: impl FnOnce(&Handles, &[Arc<Record>])) -> Option<String> {
    let directory = tempfile::tempdir().unwrap();
    let store = Arc::new(Store::open(directory.path(), Durability::Fsync).unwrap());
    let entry = Entry {
        uid: Uid::unique(),
        name: "arm".into(),
        space: "R1".parse().unwrap(),
        payload_encoding: Default::default(),
    };
    let index = Index::new(0, entry, State::new(Origin::START, Sum::default()));
    let append = |head| {
        let position = index.pin(&store).unwrap().position();
        let record = Arc::new(Record::after(position, effects(head)));
        index.submit(&store, Arc::clone(&record), |_| ()).unwrap();
        record
    };
    let records: Vec<_> = (0..3).map(append).collect();
    let handles = store.handles().unwrap();
    damage(&handles, &records);
    let mark = Some(index.head_mark());
    match state(&handles, &index, mark.as_ref()) {
        Ok(found) => index.set_recovered(found),
        Err(error) => return Some(error.to_string()),
    }
    drop(handles);
    let error = index.pin(&store).err()?;
    assert_eq!(index.durable(), Err(error.clone()));
    Some(error.to_string())
}

#[test]
fn a_chain_of_records_with_another_link_is_not_taken() {
    assert_eq!(found(|_, _| ()), None);
    let put = |handles: &Handles, record: &Record| {
        let key = record_key(0, record.revision());
        handles.keyspace.insert(key, record.encode()).unwrap();
    };
    // The third record detects a replaced second one; the mark detects a replaced third one.
    for revision in [2, 3] {
        let other = found(|handles, records| {
            let before = *records[revision - 1].previous();
            put(
                handles,
                &Record::new(revision as u64, before, 0, effects(9)),
            );
        });
        let damage = other.unwrap_or_default();
        assert!(damage.contains("revision 3 is damaged"), "{damage}");
    }
    let unlinked = found(|handles, records| {
        put(
            handles,
            &Record::new(2, [7; 32], 0, records[1].effects().clone()),
        );
    });
    assert!(unlinked.is_some_and(|error| error.contains("revision 2 is damaged")));
    let missing = found(|handles, _| {
        handles.keyspace.remove(record_key(0, 2)).unwrap();
    });
    assert!(missing.is_some_and(|error| error.contains("it is missing")));
}

#[test]
fn a_point_that_does_not_match_its_checksum_is_noticed() {
    let damaged = found(|handles, _| {
        handles
            .keyspace
            .insert(point_key(0, 1), b"damaged")
            .unwrap();
    });
    assert!(damaged.is_some_and(|error| error.contains("the point with id 1 is damaged")));
}

/// The state after fjall skipped a part of its journal whose records had been trimmed.
#[test]
fn points_that_are_missing_or_back_or_older_are_noticed() {
    type Damage = fn(&Handles);
    // The form in which the first record stored a point.
    fn store(handles: &Handles, id: u64) {
        let point = PointRef {
            id,
            tag: 0,
            revision: 1,
            row: &[0.5],
        };
        let value = point::encode(0, point, 1, b"grasp");
        handles.keyspace.insert(point_key(0, id), value).unwrap();
    }
    let damages: [(&str, Damage); 3] = [
        ("missing", |handles| {
            handles.keyspace.remove(point_key(0, 1)).unwrap();
        }),
        ("back", |handles| store(handles, 0)),
        ("older", |handles| store(handles, 1)),
    ];
    for (what, damage) in damages {
        let why = found(|handles, _| damage(handles));
        let why = why.unwrap_or_default();
        assert!(
            why.contains("points are missing, or are not those of revision 3"),
            "{what}: {why}"
        );
    }
}
