//! Pending writes without a server: their payloads, the room that they take, and refusals.

use std::{
    cell::Cell,
    collections::{BTreeMap, VecDeque},
    future, thread,
    time::Duration,
};

use rand::{RngExt, SeedableRng, seq::IndexedRandom};
use rand_chacha::ChaCha8Rng;
use wayfold_proto::v1;

use super::{open::tests::core, *};
use crate::{
    Code, Index, InsertOptions, Refusal, Search,
    index::{local::NewRow, runtime::spawn},
    set_interrupt_check,
};

/// An index that no task serves: a call that waits fails at once. It has the id 7 and these ones to give.
fn idle(max_pending_bytes: usize, id_count: u64) -> (Arc<Core>, SharedIndex) {
    let core = core(Duration::ZERO, max_pending_bytes);
    let first_id = 100;
    let block = v1::IdBlock { first_id, id_count };
    core.pending_writes.lock().reserve(Some(block));
    let task = spawn(async {}).unwrap().abort_handle();
    let tasks = [task.clone(), task];
    (Arc::clone(&core), SharedIndex { core, tasks })
}

fn quota_exceeded() -> Error {
    Error::Refused(Box::new(Refusal {
        code: Code::ResourceExhausted,
        message: "the index is full".to_owned(),
        reason: "QUOTA_EXCEEDED".to_owned(),
        metadata: BTreeMap::new(),
        fields: Vec::new(),
        ids: Vec::new(),
        retry_after: None,
        earlier: None,
    }))
}

/// One pass over the pending writes for each id would take minutes.
#[test]
fn payloads_of_many_pending_inserts_are_read_at_once() {
    let (_, shared) = idle(16 << 20, 60_000);
    let index = Index::of_shared(shared);
    let payloads = [vec![], vec![1], vec![2]].into_iter().cycle().take(60_000);
    let payloads: Vec<Option<Vec<u8>>> = payloads.map(Some).collect();
    let insert = |payload: &Option<Vec<u8>>| {
        let options = InsertOptions::new().payload(payload.as_ref().unwrap());
        index.insert_with([0.0], options).unwrap().id
    };
    let ids: Vec<u64> = payloads.iter().map(insert).collect();
    assert_eq!(index.payloads(&ids).unwrap(), payloads);
}

/// The record of another writer may give it another payload.
#[test]
fn a_point_with_a_pending_write_that_is_stored_again_has_changed() {
    let (core, shared) = idle(1 << 20, 1);
    let index = Index::of_shared(shared);
    let store = |is_new| {
        let (id, tag, row) = (1, 0, &[1.0][..]);
        let stored = NewRow {
            id,
            tag,
            row,
            is_new,
        };
        let (mut writes, mut points) = (core.pending_writes.lock(), core.points.write());
        let applied = writes.apply([stored].into_iter(), &[], &mut points);
        applied.unwrap();
    };
    store(true);
    assert!(index.set_tag(1, 5).unwrap());
    let before = index.search([0.0], &Search::k(1)).unwrap().read_revision;
    store(false);
    let changes = index.changes(before).unwrap().unwrap();
    let changed: Vec<u64> = changes.stored.iter().map(|point| point.id).collect();
    assert_eq!(changed, [1]);
}

#[test]
fn rows_beside_pending_writes_of_others_take_the_room_that_is_left() {
    let (_, shared) = idle(64 * 32, 64);
    let index = Index::of_shared(shared);
    index.insert([0.0]).unwrap();
    let rows: Vec<[f64; 1]> = (0..64).map(|number| [f64::from(number)]).collect();
    let error = index.insert_many(&rows).unwrap_err();
    let Error::Partial { done, source, .. } = error else {
        panic!("{error}");
    };
    assert!(matches!(*source, Error::Timeout { .. }), "{source}");
    assert_eq!((done, index.len().unwrap()), (48, 49));
}

/// A thread takes the writes back before the waiting ones learn of the refusal.
#[test]
fn a_refusal_whose_writes_were_taken_back_has_its_cause() {
    let (core, shared) = idle(1 << 20, 2);
    let mut ids = Vec::new();
    let before = shared.insert_rows(&[1.0], &mut ids, None).unwrap();
    let flushed = thread::scope(|scope| {
        let flush = scope.spawn(|| core.flush(Duration::from_secs(30)));
        let waiting = Arc::clone(&core);
        wait_for(async move {
            // A caller that is about to wait calls the sender.
            waiting.urgent.notified().await;
            Ok(())
        })
        .unwrap();
        let mut writes = core.pending_writes.lock();
        core.refuse(&mut writes, quota_exceeded());
        assert_eq!(writes.take_unsent().len(), 1);
        drop(writes);
        flush.join().unwrap()
    });
    let reserved = v1::IdBlock {
        first_id: 200,
        id_count: 1,
    };
    core.pending_writes.lock().open(2, Some(reserved));
    let inserted = shared.insert_rows(&[2.0], &mut ids, Some(before));
    for refused in [flushed, inserted.map(drop)] {
        let refused = refused.unwrap_err();
        assert!(matches!(refused, Error::WritesRefused { .. }), "{refused}");
        assert_eq!(refused.reason(), Some("QUOTA_EXCEEDED"), "{refused}");
    }
}

/// A process that names all its ids needs no block, so their number has no other bound.
#[test]
fn ids_that_the_caller_chose_are_forgotten_once_their_writes_are_published() {
    let (core, shared) = idle(1 << 20, 0);
    let index = Index::of_shared(shared);
    let insert = |id| index.insert_with([0.0], InsertOptions::new().id(id));
    insert(150).unwrap();
    let mut writes = core.pending_writes.lock();
    let batch = writes.next(1, 0).unwrap().batch;
    let taken = writes.acknowledge(batch, 1, 1, &mut core.points.write());
    assert!(taken.unwrap().is_empty());
    drop(writes);
    insert(160).unwrap();
    // No server reserves an id that it has stored: here the block shows which of them are remembered.
    let (first_id, id_count) = (140, 30);
    let block = v1::IdBlock { first_id, id_count };
    let mut writes = core.pending_writes.lock();
    writes.reserve(Some(block));
    let given: Vec<u64> = std::iter::from_fn(|| writes.ids.next()).collect();
    assert!(given.contains(&150) && !given.contains(&160), "{given:?}");
}

/// The server has taken the point, and no feed will place it among those of others.
#[test]
fn the_end_of_an_index_leaves_no_search_open() {
    let (core, shared) = idle(1 << 20, 1);
    let index = Index::of_shared(shared);
    let search = Search::k(1);
    index
        .insert_with([1.0], InsertOptions::new().neighbors(search))
        .unwrap();
    let mut writes = core.pending_writes.lock();
    let batch = writes.next(1, 0).unwrap().batch;
    let taken = writes.acknowledge(batch, 1, 0, &mut core.points.write());
    assert!(taken.unwrap().is_empty());
    drop(writes);
    assert_eq!(index.meanwhile().open, 1);
    core.end(quota_exceeded());
    assert_eq!(index.meanwhile(), Default::default());
}

#[test]
fn an_interrupted_wait_takes_no_writes_and_no_answers() {
    const LONG: Duration = Duration::from_secs(3_600);
    // Other threads of this process run other tests.
    thread_local! { static IS_INTERRUPTED: Cell<bool> = const { Cell::new(false) } }
    set_interrupt_check(|| IS_INTERRUPTED.get());
    let task = spawn(async {}).unwrap().abort_handle();
    let index = Index::of_shared(SharedIndex {
        core: core(LONG, 1 << 20),
        tasks: [task.clone(), task],
    });
    let options = InsertOptions::new().neighbors(Search::k(1));
    index.insert_with([0.0], options).unwrap();
    IS_INTERRUPTED.set(true);
    let waited = index.wait_meanwhile(LONG);
    assert!(waited.answers.is_empty());
    assert_eq!(waited.open, 1);
    let interrupted = [
        // No id is left for it.
        index.insert([1.0]).map(drop),
        index.flush(),
        wait_for(future::pending::<Result<(), Error>>()),
    ];
    for waited in interrupted {
        assert!(matches!(waited, Err(Error::Interrupted)), "{waited:?}");
    }
    assert!(index.close(LONG).is_empty());
    IS_INTERRUPTED.set(false);
    assert_eq!((index.pending(), index.meanwhile().open), (1, 1));
    assert_eq!(index.close(Duration::ZERO).len(), 1);
}

/// To show the point after each of them would apply all writes before it again.
#[test]
fn many_writes_on_one_point_are_given_back_by_one_change() {
    let (core, shared) = idle(1 << 24, 0);
    let index = Index::of_shared(shared);
    let id = index.insert([0.0]).unwrap();
    for number in 1..1_000 {
        assert!(index.replace(id, [f64::from(number)]).unwrap());
    }
    let before = core.points.read().read_revision().0;
    core.refuse(&mut core.pending_writes.lock(), quota_exceeded());
    assert_eq!(core.points.read().read_revision().0, before + 1);
    assert_eq!((index.len().unwrap(), index.pending()), (0, 0));
    assert_eq!(index.take_unsent().len(), 1_000);
}

/// A random write that had an effect.
fn random_write(index: &Index, ids: &mut Vec<u64>, rng: &mut ChaCha8Rng) -> Option<UnsentWrite> {
    let state = vec![f64::from(rng.random_range(0..4_u8))];
    let payload = vec![1; rng.random_range(0..2)];
    let tag = rng.random_range(0..3);
    let id = ids.choose(rng).copied().unwrap_or(0);
    let options = InsertOptions::new().tag(tag).payload(&payload);
    let (write, has_effect) = match rng.random_range(0..9) {
        kind @ 0..=2 => {
            let options = match kind {
                0 => options.id((1 << 40) + rng.random_range(0..5)),
                _ => options,
            };
            let id = match index.insert_with(&state[..], options) {
                Err(Error::IdTaken { .. }) => return None,
                inserted => inserted.unwrap().id,
            };
            ids.push(id);
            let put = UnsentWrite::Put {
                id,
                tag,
                state,
                payload,
            };
            (put, true)
        }
        3..=4 => {
            let is_stored = index.replace(id, &state[..]).unwrap();
            (UnsentWrite::Replace { id, state }, is_stored)
        }
        5 => (UnsentWrite::Remove { id }, index.remove(id).unwrap()),
        6 => {
            let is_stored = index.set_tag(id, tag).unwrap();
            (UnsentWrite::SetTag { id, tag }, is_stored)
        }
        _ => {
            let is_stored = index.set_payload(id, &payload).unwrap();
            (UnsentWrite::SetPayload { id, payload }, is_stored)
        }
    };
    has_effect.then_some(write)
}

/// The tags and the numbers of points.
type Content = BTreeMap<u64, (u64, f64)>;

fn apply(write: &UnsentWrite, points: &mut Content) {
    match write {
        UnsentWrite::Put { id, tag, state, .. } => {
            points.insert(*id, (*tag, state[0]));
        }
        UnsentWrite::Replace { id, state } => {
            points.entry(*id).and_modify(|point| point.1 = state[0]);
        }
        UnsentWrite::Remove { id } => {
            points.remove(id);
        }
        UnsentWrite::SetTag { id, tag } => {
            points.entry(*id).and_modify(|point| point.0 = *tag);
        }
        UnsentWrite::SetPayload { .. } => {}
    }
}

/// The payloads that the copy knows: those of pending writes, and none of points that are gone.
fn check_payloads(index: &Index, ids: &[u64], pending: &VecDeque<UnsentWrite>) {
    let mut last = BTreeMap::new();
    for write in pending {
        match write {
            UnsentWrite::Put { id, payload, .. } | UnsentWrite::SetPayload { id, payload } => {
                last.insert(*id, payload.clone());
            }
            UnsentWrite::Replace { id, .. } => {
                last.insert(*id, Vec::new());
            }
            UnsentWrite::Remove { .. } | UnsentWrite::SetTag { .. } => {}
        }
    }
    let is_stored = |id| index.get(id).unwrap().is_some();
    // The server would be asked for the other ones.
    let known = ids.iter().copied();
    let known: Vec<u64> = known
        .filter(|id| last.contains_key(id) || !is_stored(*id))
        .collect();
    let expected = known.iter().map(|id| match is_stored(*id) {
        true => last.get(id).cloned(),
        false => None,
    });
    let expected: Vec<Option<Vec<u8>>> = expected.collect();
    assert_eq!(index.payloads(&known).unwrap(), expected);
    for (&id, payload) in known.iter().zip(expected) {
        assert_eq!(index.payload(id).unwrap(), payload);
    }
}

/// Its state is the same before and after the refusal, and its payload is not.
#[test]
fn a_payload_that_a_refusal_gives_back_is_a_change() {
    let (core, shared) = idle(1 << 20, 1);
    let index = Index::of_shared(shared);
    let options = InsertOptions::new().payload(b"p");
    let id = index.insert_with([1.0], options).unwrap().id;
    let batch = core.pending_writes.lock().next(1, 0).unwrap().batch;
    let confirmed = core
        .pending_writes
        .lock()
        .confirm(1, batch, &mut core.points.write());
    confirmed.unwrap().unwrap();
    index.replace(id, [2.0]).unwrap();
    index.replace(id, [1.0]).unwrap();
    let since = core.points.read().read_revision();
    core.refuse(&mut core.pending_writes.lock(), quota_exceeded());
    let changes = index.changes(since).unwrap().unwrap();
    assert_eq!(changes.stored.len(), 1);
    assert_eq!(changes.stored[0].id, id);
}

#[test]
fn random_pending_writes_keep_their_payloads_and_are_given_back_in_order() {
    for seed in 0..20 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (core, shared) = idle(1 << 24, 1_000);
        // Smaller than what is written between two of them: several batches wait.
        core.pending_writes.lock().limits.max_rows_per_call = 8;
        let index = Index::of_shared(shared);
        let (mut ids, mut pending) = (Vec::new(), VecDeque::new());
        let mut published = Content::new();
        for step in 0..500 {
            pending.extend(random_write(&index, &mut ids, &mut rng));
            let is_last_sent = step == 450;
            if is_last_sent || step < 450 && rng.random_bool(0.05) {
                let mut writes = core.pending_writes.lock();
                let Some(batch) = writes.next(1, 0) else {
                    continue;
                };
                let points = &mut core.points.write();
                if is_last_sent {
                    // The server takes it, and the feed does not name it yet.
                    writes.acknowledge(batch.batch, 1, 0, points).unwrap();
                } else {
                    writes.confirm(1, batch.batch, points).unwrap().unwrap();
                }
                let sent = pending.drain(..batch.ids.len());
                sent.for_each(|write| apply(&write, &mut published));
            }
            if step < 450 && step % 10 == 0 {
                check_payloads(&index, &ids, &pending);
            }
        }
        core.refuse(&mut core.pending_writes.lock(), quota_exceeded());
        assert_eq!(index.take_unsent(), Vec::from(pending));
        let held = ids
            .iter()
            .filter_map(|id| Some((*id, index.get(*id).unwrap()?)));
        let held: Content = held
            .map(|(id, point)| (id, (point.tag, point.state[0])))
            .collect();
        assert_eq!(held, published, "seed {seed}");
        assert_eq!(index.pending(), 0);
    }
}
