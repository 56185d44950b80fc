//! The task that applies the mutations of the server to the copy.

use std::{sync::Arc, time::Duration};

use tokio::time::{Instant, sleep_until};

use super::{core::Core, link::protocol};
use crate::{
    Code, Error, IndexHandle, Mutation, Reset, ResetReason, WatchEvent, index::local::NewRow,
};

/// The time for which no index may have the name: one that is deleted and created again has it soon.
const MISSING_TIME: Duration = Duration::from_secs(5);

/// The changes that a copy which is read again skips, so that writes go on while it is read.
const RELOAD_CHANGES: u64 = 1 << 40;

pub(super) struct Follower {
    core: Arc<Core>,
    index: IndexHandle,
    /// The newest revision that was applied.
    revision: u64,
    /// The time since which no index has the name.
    missing: Option<Instant>,
    failures: u32,
}

/// The reason for which following stopped.
enum Stop {
    /// The server cannot send the next mutations.
    Reset(Reset),
    Failed(Error),
}

impl From<Error> for Stop {
    fn from(error: Error) -> Stop {
        Stop::Failed(error)
    }
}

impl Follower {
    pub(super) fn new(core: Arc<Core>, index: IndexHandle, revision: u64) -> Follower {
        Follower {
            core,
            index,
            revision,
            missing: None,
            failures: 0,
        }
    }

    /// Follows until the index is gone.
    pub(super) async fn run(mut self) {
        loop {
            let Err(stop) = self.follow().await;
            let failed = match stop {
                Stop::Failed(error) => Err(error),
                Stop::Reset(reset) => self.reload(&reset).await,
            };
            let recovered = match failed {
                Ok(()) => Ok(()),
                Err(error) => self.recover(error).await,
            };
            if let Err(why) = recovered {
                return self.core.end(why);
            }
        }
    }

    async fn follow(&mut self) -> Result<std::convert::Infallible, Stop> {
        let after = self.index.revision_at(self.revision);
        let session = self.core.writer.lock().session.unwrap_or(0);
        let mut watch = self.core.link.watch(&self.index, after, session).await?;
        loop {
            while let Some(event) = watch.ready() {
                match event {
                    WatchEvent::Mutation(mutation) => self.apply(&mutation)?,
                    WatchEvent::Reset(reset) => return Err(Stop::Reset(reset)),
                }
            }
            (self.missing, self.failures) = (None, 0);
            self.core
                .following(watch.newest().number.saturating_sub(self.revision));
            match watch.next().await? {
                Some(WatchEvent::Mutation(mutation)) => self.apply(&mutation)?,
                Some(WatchEvent::Reset(reset)) => return Err(Stop::Reset(reset)),
                None => return Err(Stop::Failed(protocol("the feed ended".to_owned()))),
            }
        }
    }

    /// Applies the next mutation: readers see all of it at once.
    fn apply(&mut self, mutation: &Mutation) -> Result<(), Error> {
        let core = &*self.core;
        let mut writer = core.writer.lock();
        let mut points = core.points.write();
        let number = mutation.revision.number;
        match mutation.session {
            session if session != 0 && writer.session == Some(session) => {
                writer.confirm(mutation.batch, &mut points)?;
                core.progress.notify_all();
            }
            session if writer.is_past(session) => {}
            _ => {
                let stored = mutation.stored.iter().map(|point| NewRow {
                    id: point.id,
                    tag: point.tag,
                    row: point.state,
                    is_new: point.revision == number,
                });
                writer.apply(stored, &mutation.removed_ids, &mut points)?;
            }
        }
        core.after_change(&mut points);
        self.revision = number;
        core.published.lock().1 = number;
        Ok(())
    }

    /// Reads all points again, and shows them with the pending writes in place of the old ones.
    async fn reload(&mut self, reset: &Reset) -> Result<(), Error> {
        let core = Arc::clone(&self.core);
        core.reloading();
        let is_same = reset.reason == ResetReason::WindowPassed;
        let index = match is_same {
            true => self.index.clone(),
            false => core.link.index().await?,
        };
        if index.space() != &core.space {
            return Err(Error::OtherSpace {
                index: index.name().to_owned(),
                expected: core.space.to_string(),
                found: index.space().to_string(),
            });
        }
        let at = core.points.read().seen().0 + RELOAD_CHANGES;
        let (forest, revision) = core.link.load(&index, at).await?;
        let is_remade = index.uid() != self.index.uid();
        if is_remade {
            // Its writer session and pending writes belong to the history that is gone.
            let uid = self.index.revision_at(self.revision).check_uid(index.uid());
            core.lose_session(uid.err().unwrap_or(Error::Closed));
        }
        let mut writer = core.writer.lock();
        let mut points = core.points.write();
        points.replace(forest);
        writer.reloaded(&mut points)?;
        core.after_change(&mut points);
        *core.published.lock() = (index.clone(), revision);
        (self.index, self.revision) = (index, revision);
        Ok(())
    }

    /// Waits before the next attempt, or returns the reason to make none.
    async fn recover(&mut self, error: Error) -> Result<(), Error> {
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
        let pause = self.core.link.pause(self.failures);
        self.core.disconnected(error);
        sleep_until(Instant::now() + pause).await;
        Ok(())
    }
}
