//! The versions of points that a store keeps for its views.

use bytes::Bytes;
use wayfold_index::PointRef;

use super::*;
use crate::log::{Effects, Outcome};

fn storing(ids: std::ops::Range<u64>, revision: u64) -> Effects {
    let mut effects = Effects::new(1);
    for id in ids {
        let point = PointRef {
            id,
            tag: 0,
            revision,
            row: &[0.0],
        };
        effects.store(point, Outcome::Inserted, Bytes::new());
    }
    effects
}

fn append(store: &Arc<Store>, effects: Effects) {
    let position = store.journal.lock().head.position;
    let record = Arc::new(Record::after(position, effects));
    store.submit(Arc::clone(&record)).unwrap();
    drop(store.apply(&[record]).unwrap());
}

#[test]
fn only_what_a_view_sees_is_kept_beside_the_points() {
    let store = Arc::new(Store::new(
        Uid::unique(),
        Origin::START,
        Vec::new(),
        Sessions::default(),
    ));
    let versions = || store.versions.read().len();
    for revision in 1..=3 {
        append(&store, storing(0..2000, revision));
        assert_eq!(versions(), 2000);
    }
    let view = Arc::clone(&store).pin();
    append(&store, storing(0..2000, 4));
    assert_eq!(versions(), 4000);
    let mut effects = Effects::new(1);
    (0..1500).for_each(|id| effects.remove(id));
    append(&store, effects);
    // Each of the view's versions, and for each point the version or mark that superseded it.
    assert_eq!(versions(), 4000);
    drop(view);
    while store.collect() {}
    assert_eq!(versions(), 500);
}

#[test]
fn an_old_view_keeps_no_version_that_it_does_not_see() {
    let store = Arc::new(Store::new(
        Uid::unique(),
        Origin::START,
        Vec::new(),
        Sessions::default(),
    ));
    let versions = || store.versions.read().len();
    append(&store, storing(0..2000, 1));
    let old = Arc::clone(&store).pin();
    let mut newest = Arc::clone(&store).pin();
    for revision in 2..30 {
        append(&store, storing(0..2000, revision));
        newest = Arc::clone(&store).pin();
        // The points, the versions of the old view, and the versions that were just superseded.
        assert!(versions() <= 3 * 2000, "{}", versions());
    }
    drop(newest);
    while store.collect() {}
    assert_eq!(versions(), 2 * 2000);
    assert_eq!(old.page(None, 3000).unwrap().len(), 2000);
}

#[test]
fn letting_go_of_a_view_leaves_most_of_the_work_to_later_records() {
    let store = Arc::new(Store::new(
        Uid::unique(),
        Origin::START,
        Vec::new(),
        Sessions::default(),
    ));
    let versions = || store.versions.read().len();
    append(&store, storing(0..20_000, 1));
    let old = Arc::clone(&store).pin();
    append(&store, storing(0..20_000, 2));
    drop(old);
    let waiting = versions() - 20_000;
    assert_eq!(waiting, 20_000 - ROWS_PER_HOLD);
    for revision in 3.. {
        if versions() == 20_000 {
            break;
        }
        let before = versions();
        append(&store, storing(0..10, revision));
        assert!(versions() < before);
    }
}
