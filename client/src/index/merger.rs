//! The thread that merges the levels of all indices of this process.
//!
//! It starts with the first change. A merge runs without any lock, and its result is swapped in under the index's lock.
//! When an index rests, the thread packs its levels into few.

use std::{
    collections::VecDeque,
    sync::{
        OnceLock, Weak,
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    thread,
    time::Duration,
};

use wayfold_index::Merge;

use super::{local::LocalPoints, origin::Origin};

/// An index rests when nothing changes for this long.
const REST: Duration = Duration::from_millis(250);

/// An index whose levels are merged here.
pub(super) trait Merged: Send + Sync {
    /// Runs `change` with exclusive access to the points.
    fn with_points(&self, change: &mut dyn FnMut(&mut LocalPoints));
}

/// The work that a change leaves behind.
enum Work {
    Merge(Weak<dyn Merged>, Merge),
    /// Look for a pause in the changes of an index.
    Watch(Weak<dyn Merged>),
}

struct Thread {
    work: Sender<Work>,
    /// The process that started it.
    origin: Origin,
}

static THREAD: OnceLock<Option<Thread>> = OnceLock::new();

/// Hands over the work that changes have left: call it under the index's lock after each.
pub(super) fn after_change(points: &mut LocalPoints, index: impl Fn() -> Weak<dyn Merged>) {
    if !points.is_watched {
        points.is_watched = true;
        send(points, Work::Watch(index()));
    }
    if let Some(merge) = points.merge() {
        send(points, Work::Merge(index(), merge));
    }
}

/// Runs all merges that are due at once.
pub(super) fn merge_now(points: &mut LocalPoints) {
    while let Some(merge) = points.merge() {
        points.forest.finish_merge(merge.run());
    }
}

fn send(points: &mut LocalPoints, work: Work) {
    let thread = THREAD.get_or_init(start).as_ref();
    // In a forked process, and where no thread could be started, the caller merges.
    let unsent = match thread.filter(|thread| thread.origin.is_here()) {
        Some(thread) => thread.work.send(work).err().map(|unsent| unsent.0),
        None => Some(work),
    };
    if let Some(Work::Merge(_, merge)) = unsent {
        points.forest.finish_merge(merge.run());
        merge_now(points);
    }
}

fn start() -> Option<Thread> {
    let (work, received) = channel();
    thread::Builder::new()
        .name("wayfold-merge".to_owned())
        .spawn(move || run(&received))
        .ok()?;
    Some(Thread {
        work,
        origin: Origin::here(),
    })
}

/// An index that changed not long ago, and its last change that the thread has noticed.
struct Watched {
    index: Weak<dyn Merged>,
    noticed: u64,
}

fn run(work: &Receiver<Work>) {
    let mut watched: Vec<Watched> = Vec::new();
    // The indices take turns, also where merges lead to others.
    let mut due: VecDeque<(Weak<dyn Merged>, Merge)> = VecDeque::new();
    loop {
        let next = match (due.is_empty(), watched.is_empty()) {
            (false, _) => work.recv_timeout(Duration::ZERO),
            (true, true) => work.recv().map_err(RecvTimeoutError::from),
            (true, false) => work.recv_timeout(REST),
        };
        match next {
            Ok(Work::Merge(index, merge)) => due.push_back((index, merge)),
            Ok(Work::Watch(index)) => watched.push(Watched {
                index,
                noticed: u64::MAX,
            }),
            Err(RecvTimeoutError::Timeout) => match due.pop_front() {
                Some((index, merge)) => {
                    let merged = merge.run();
                    due.extend(finish(&index, merged).map(|next| (index, next)));
                }
                None => watched.retain_mut(|watched| {
                    let (changes, next) = look(watched);
                    due.extend(next.map(|next| (Weak::clone(&watched.index), next)));
                    changes
                }),
            },
            // The sender is in a static.
            Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}

/// Swaps a level in. Returns the merge that it leads to.
fn finish(index: &Weak<dyn Merged>, merged: wayfold_index::Merged) -> Option<Merge> {
    let (mut merged, mut next, mut replaced) = (Some(merged), None, None);
    index.upgrade()?.with_points(&mut |points| {
        replaced = merged
            .take()
            .map(|merged| points.forest.finish_merge(merged));
        next = points.forest.begin_merge();
    });
    drop(replaced);
    next
}

/// True if the index has changed since the last look. If not, it rests, and its next merge works towards one level.
fn look(watched: &mut Watched) -> (bool, Option<Merge>) {
    let (mut changes, mut next) = (false, None);
    if let Some(index) = watched.index.upgrade() {
        index.with_points(&mut |points| {
            let newest = points.seen().0;
            changes = std::mem::replace(&mut watched.noticed, newest) != newest;
            if !changes {
                points.is_watched = false;
                points.forest.pause();
                next = points.forest.begin_merge();
            }
        });
    }
    (changes, next)
}
