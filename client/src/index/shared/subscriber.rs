//! The task that applies the mutations of the server to the copy.

use std::{sync::Arc, time::Duration};

use parking_lot::{MutexGuard, RwLockWriteGuard};
use tokio::time::{Instant, sleep_until};

use super::{
    core::{Core, Task},
    meanwhile::{Answerable, Reloaded},
    pending::PendingWrites,
};
use crate::{
    Code, Error, IndexInfo, Mutation, Reset, ResetReason, Watch, WatchEvent,
    index::local::{LocalPoints, NewRow},
    net::connections::Connection,
};

/// The time for which the name may be missing before the index counts as deleted: it may be created again at once.
const MISSING_TIME: Duration = Duration::from_secs(5);

/// A reload numbers its points this many changes later, so that writes made during the reload get smaller numbers.
const RELOAD_CHANGES: u64 = 1 << 40;

/// A feed that has stood for this long has recovered: the pause after its end is short again.
const RECOVERY_TIME: Duration = Duration::from_secs(1);

/// The rows and mutations after which the lock of the copy is given back between two mutations: inserts and searches
/// wait for less than a millisecond.
const MAX_LOCKED_ROWS: usize = 256;

pub(super) struct Subscriber {
    core: Arc<Core>,
    index: Arc<IndexInfo>,
    /// The newest revision that was applied.
    revision: u64,
    /// The session whose mutations the feed must include, because it left out some that this process needs; 0 for none.
    unfiltered: u64,
    /// The time since which no index has the name.
    missing: Option<Instant>,
    /// The number of failures since the last mutation, or since the last feed that stood for [`RECOVERY_TIME`].
    failures: u32,
    /// The number of reloads since the last mutation.
    reloads: u32,
}

/// The reason for which following stopped.
enum Stop {
    /// The server cannot send the next mutations.
    Reset(Reset),
    /// The feed left out what this process needs of the session after all.
    Unfiltered(u64),
    /// The feed may leave out another session from now on.
    OtherSession,
    Failed(Error),
}

impl From<Error> for Stop {
    fn from(error: Error) -> Stop {
        Stop::Failed(error)
    }
}

impl Subscriber {
    pub(super) fn new(core: Arc<Core>, index: Arc<IndexInfo>, revision: u64) -> Subscriber {
        Subscriber {
            core,
            index,
            revision,
            unfiltered: 0,
            missing: None,
            failures: 0,
            reloads: 0,
        }
    }

    /// Follows until the index is gone.
    pub(super) async fn run(mut self) {
        loop {
            let asked = self.core.link.connection();
            let Err(stop) = self.follow().await;
            let failed = match stop {
                Stop::Failed(error) => Err(error),
                Stop::Reset(reset) => self.reload(&reset).await,
                Stop::Unfiltered(session) => {
                    self.unfiltered = session;
                    Ok(())
                }
                Stop::OtherSession => Ok(()),
            };
            let recovered = match failed {
                Ok(()) => Ok(()),
                Err(error) => self.recover(asked.as_ref(), error).await,
            };
            if let Err(why) = recovered {
                return self.core.end(why);
            }
        }
    }

    async fn follow(&mut self) -> Result<std::convert::Infallible, Stop> {
        let session = self.own_session();
        let watch = self.core.link.watch(&self.index, self.revision, session);
        let mut watch = watch.await?;
        let opened = Instant::now();
        self.missing = None;
        loop {
            self.core
                .set_following(watch.newest().number.saturating_sub(self.revision));
            let next = tokio::select! {
                next = watch.next() => next,
                () = self.core.session_opened.notified() => {
                    // The own writes would come back with their points.
                    if self.own_session() != session {
                        return Err(Stop::OtherSession);
                    }
                    continue;
                }
            };
            if opened.elapsed() >= RECOVERY_TIME {
                self.failures = 0;
            }
            match next? {
                Some(first) => self.apply(first, &mut watch, session)?,
                None => return Err(Error::protocol("watch", "the feed ended").into()),
            }
        }
    }

    /// The session whose mutations the feed may leave out; 0 for none.
    fn own_session(&self) -> u64 {
        let session = self.core.pending_writes.lock().session;
        session
            .filter(|session| *session != self.unfiltered)
            .unwrap_or(0)
    }

    /// Applies the next event, and those of the same message up to [`MAX_LOCKED_ROWS`]: readers see them at once. The
    /// feed leaves out the points that `left_out` wrote.
    fn apply(&mut self, first: WatchEvent, watch: &mut Watch, left_out: u64) -> Result<(), Stop> {
        let core = Arc::clone(&self.core);
        let mut writes = core.pending_writes.lock();
        let mut points = core.points.write();
        let (mut answerable, mut rows) = (Vec::new(), 0);
        let (mut next, mut applied) = (Some(first), Ok(()));
        while let Some(event) = next {
            applied = match event {
                WatchEvent::Mutation(mutation) => {
                    rows += 1 + mutation.stored.len() + mutation.removed_ids.len();
                    apply(&mutation, left_out, &mut writes, &mut points).map(|answers| {
                        answerable.extend(answers);
                        self.revision = mutation.revision.number;
                        (self.failures, self.reloads) = (0, 0);
                    })
                }
                WatchEvent::Reset(reset) => Err(Stop::Reset(reset)),
            };
            let goes_on = applied.is_ok() && rows < MAX_LOCKED_ROWS;
            next = if goes_on { watch.ready() } else { None };
        }
        core.progress.notify_all();
        core.after_change(&mut points);
        core.published.lock().1 = self.revision;
        // The next event may take the locks again at once: threads that wait for them have them first.
        RwLockWriteGuard::unlock_fair(points);
        MutexGuard::unlock_fair(writes);
        core.answer(answerable);
        applied
    }

    /// Reads all points again, and shows them with the pending writes in place of the old ones.
    async fn reload(&mut self, reset: &Reset) -> Result<(), Error> {
        let core = Arc::clone(&self.core);
        core.set_reloading();
        self.reloads += 1;
        if self.reloads > 1 {
            // Reading takes longer than the server keeps mutations.
            sleep_until(Instant::now() + core.link.pause(self.reloads, None)).await;
        }
        let is_same = reset.reason == ResetReason::WindowPassed;
        let index = match is_same {
            true => Arc::clone(&self.index),
            false => {
                let index = core.link.index().await?;
                // Another server may answer, and lag behind the one that ended the feed.
                reset.revision.check_uid(index.uid())?;
                Arc::new(index)
            }
        };
        if index.space != core.space {
            return Err(Error::OtherSpace {
                index: index.name.clone(),
                expected: core.space.to_string(),
                found: index.space.to_string(),
            });
        }
        let change = core.points.read().read_revision().0 + RELOAD_CHANGES;
        // A server that lags behind the copy waits for the revision, or refuses the read.
        let min_revision = match index.uid() == self.index.uid() {
            true => self.revision,
            false => 0,
        };
        let loaded = core.link.load(&index, min_revision, change).await?;
        let (forest, revision, revisions) = loaded;
        let old = core.points.read().forest.snapshot();
        let comparing = tokio::task::spawn_blocking(move || {
            let changes = Reloaded::between(&old, &forest.snapshot(), &revisions);
            (forest, changes)
        });
        let compared = comparing.await;
        let (forest, changes) = compared.map_err(|error| {
            Error::protocol("scan", format!("its points cannot be compared: {error}"))
        })?;
        let mut writes = core.pending_writes.lock();
        if index.uid() != self.index.uid() {
            // Its writer session and pending writes belong to the history that is gone.
            if writes.has_session() {
                let uid = self.index.revision_at(self.revision).check_uid(index.uid());
                core.refuse(&mut writes, uid.err().unwrap_or(Error::Closed));
            }
            writes.forget_history();
        }
        let mut points = core.points.write();
        let old = points.replace(forest);
        let answerable = writes.reloaded(revision, &changes, &mut points)?;
        core.after_change(&mut points);
        *core.published.lock() = (Arc::clone(&index), revision);
        core.wake(&mut writes);
        core.progress.notify_all();
        drop(points);
        drop(writes);
        drop(old);
        (self.index, self.revision) = (index, revision);
        core.answer(answerable);
        Ok(())
    }

    /// Waits before the next attempt, or returns the reason to make none.
    async fn recover(&mut self, asked: Option<&Connection>, error: Error) -> Result<(), Error> {
        if self.core.link.may_lag(&error) {
            self.core.link.leave(asked);
        }
        match error.code() {
            Code::NotFound => {
                let since = *self.missing.get_or_insert_with(Instant::now);
                if since.elapsed() >= MISSING_TIME {
                    return Err(error);
                }
            }
            Code::Unimplemented => return Err(error),
            _ if matches!(error, Error::OtherSpace { .. }) => return Err(error),
            _ => self.missing = None,
        }
        self.failures = self.failures.saturating_add(1);
        let pause = self.core.link.pause(self.failures, Some(&error));
        self.core.set_disconnected(Task::Subscriber, error);
        sleep_until(Instant::now() + pause).await;
        Ok(())
    }
}

/// Applies a mutation to the copy. Returns the searches that it answers.
fn apply(
    mutation: &Mutation,
    left_out: u64,
    writes: &mut PendingWrites,
    points: &mut LocalPoints,
) -> Result<Vec<Answerable>, Stop> {
    let (session, number) = (mutation.session, mutation.revision.number);
    if session != 0
        && writes.is_own(session)
        && let Some(answerable) = writes.confirm(session, mutation.batch, points)?
    {
        return Ok(answerable);
    }
    if session != 0 && session == left_out {
        // A batch that was given back to the caller, and that the server had taken after all.
        return Err(Stop::Unfiltered(session));
    }
    let stored = mutation.stored.iter().map(|point| NewRow {
        id: point.id,
        tag: point.tag,
        row: point.state,
        is_new: point.revision == number,
    });
    writes.apply(stored, &mutation.removed_ids, points)?;
    Ok(Vec::new())
}
