//! The two threads that merge the levels of all indices of this process.
//!
//! They start with the first change. One has a low priority and runs merges, the indices in turn, without any lock. The
//! other swaps the results in under the index's lock: at a low priority it would be preempted while it holds the lock,
//! and a planner would wait for it. When an index rests, its levels are packed into few.

use std::{
    sync::{
        OnceLock, Weak,
        mpsc::{Receiver, RecvTimeoutError, SendError, Sender, channel},
    },
    thread,
    time::{Duration, Instant},
};

use wayfold_index::Merge;

use super::{local::LocalPoints, origin::Origin};

/// An index rests when nothing changes for this long.
const REST: Duration = Duration::from_millis(250);

/// The nice value of the thread that merges. A planner's thread preempts it: at the planner's priority, merges would
/// delay the slowest inserts into a shared index for longer. Planners on all cores are no slower for it.
#[cfg(target_os = "linux")]
const MERGE_NICE: i32 = 5;

/// An index whose levels are merged here.
pub(super) trait MergeOwner: Send + Sync {
    /// Runs `change` with exclusive access to the points.
    fn with_points(&self, change: &mut dyn FnMut(&mut LocalPoints));
}

/// An index, and what is done with it.
enum Work {
    /// Swap a level in.
    Merged(Weak<dyn MergeOwner>, wayfold_index::Merged),
    /// Look for a pause in the changes.
    Watch(Weak<dyn MergeOwner>),
}

/// The way to the two threads.
struct Threads {
    merges: Sender<(Weak<dyn MergeOwner>, Merge)>,
    work: Sender<Work>,
    /// The process that started them.
    origin: Origin,
}

static THREADS: OnceLock<Option<Threads>> = OnceLock::new();

/// Hands over the work that changes have left: call it under the index's lock after each.
pub(super) fn after_change(points: &mut LocalPoints, index: impl Fn() -> Weak<dyn MergeOwner>) {
    // In a forked process, and where no thread could be started, the caller merges.
    let threads = THREADS.get_or_init(start).as_ref();
    let Some(threads) = threads.filter(|threads| threads.origin.is_current()) else {
        points.settle();
        return;
    };
    if !points.is_watched {
        points.is_watched = true;
        // A send fails only after the thread has panicked, and the panic hook has printed that.
        let _ = threads.work.send(Work::Watch(index()));
    }
    if let Some(merge) = points.merge()
        && let Err(SendError((_, merge))) = threads.merges.send((index(), merge))
    {
        points.forest.finish_merge(merge.run());
        points.settle();
    }
}

fn start() -> Option<Threads> {
    let (merges, due) = channel::<(Weak<dyn MergeOwner>, Merge)>();
    let (work, received) = channel();
    let (more, merged) = (merges.clone(), work.clone());
    let thread = |name: &str| thread::Builder::new().name(name.to_owned());
    let merging = thread("wayfold-merge").spawn(move || {
        lower_priority();
        for (index, merge) in due {
            // Its index was dropped or cleared.
            if !merge.is_wanted() {
                continue;
            }
            if merged.send(Work::Merged(index, merge.run())).is_err() {
                return;
            }
        }
    });
    merging.ok()?;
    thread("wayfold-swap")
        .spawn(move || run(&received, &more, REST))
        .ok()?;
    Some(Threads {
        merges,
        work,
        origin: Origin::current(),
    })
}

/// Lowers the priority of this thread; only Linux has one per thread.
fn lower_priority() {
    #[cfg(target_os = "linux")]
    // Without it merges delay the planner, and nothing else is different.
    let _ = rustix::process::setpriority_process(None, MERGE_NICE);
}

/// An index that changed not long ago, and its last change that the thread has noticed.
struct Watched {
    index: Weak<dyn MergeOwner>,
    noticed: u64,
}

fn run(work: &Receiver<Work>, merges: &Sender<(Weak<dyn MergeOwner>, Merge)>, rest: Duration) {
    let mut watched: Vec<Watched> = Vec::new();
    // The time of the next look at the watched indices. Messages do not postpone it.
    let mut look_at = Instant::now();
    loop {
        let wait = look_at.saturating_duration_since(Instant::now());
        let next = match watched.is_empty() {
            true => work.recv().map_err(RecvTimeoutError::from),
            false if wait.is_zero() => Err(RecvTimeoutError::Timeout),
            false => work.recv_timeout(wait),
        };
        let mut due = Vec::new();
        match next {
            Ok(Work::Merged(index, merged)) => {
                due.extend(finish(&index, merged).map(|next| (index, next)));
            }
            Ok(Work::Watch(index)) => {
                if watched.is_empty() {
                    look_at = Instant::now() + rest;
                }
                watched.push(Watched {
                    index,
                    noticed: u64::MAX,
                });
            }
            Err(RecvTimeoutError::Timeout) => {
                watched.retain_mut(|watched| {
                    let (changes, next) = look(watched);
                    due.extend(next.map(|next| (Weak::clone(&watched.index), next)));
                    changes
                });
                look_at = Instant::now() + rest;
            }
            // The senders are in a static.
            Err(RecvTimeoutError::Disconnected) => return,
        }
        for merge in due {
            if merges.send(merge).is_err() {
                return;
            }
        }
    }
}

/// Swaps a level in. Returns the merge that it leads to.
fn finish(index: &Weak<dyn MergeOwner>, merged: wayfold_index::Merged) -> Option<Merge> {
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
            let newest = points.read_revision().0;
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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::index::memory::{Memory, Merges};

    #[test]
    fn messages_do_not_keep_an_index_from_its_rest() {
        let space = "R1".parse().unwrap();
        let index = Memory::new(&space, Merges::Background);
        index.with_points(&mut |points| {
            for id in 0..200 {
                points.store(id, 0, &[id as f64]).unwrap();
            }
            points.is_watched = true;
        });
        let (work, received) = channel();
        let (merges, due) = channel();
        let watched = Arc::downgrade(&index);
        work.send(Work::Watch(watched)).unwrap();
        for _ in 0..10 {
            let dropped = Arc::downgrade(&Memory::new(&space, Merges::Background));
            work.send(Work::Watch(dropped)).unwrap();
        }
        drop(work);
        // A look is due at once, while messages wait.
        run(&received, &merges, Duration::ZERO);
        let (_, merge) = due.try_recv().unwrap();
        assert_eq!(merge.rows(), 200);
        index.with_points(&mut |points| assert!(!points.is_watched));
    }
}
