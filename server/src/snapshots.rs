//! Snapshots of all indices that the server takes itself, by a schedule.
//!
//! Each index has a directory of its own. The name of a snapshot holds its time, the uid of the index and the revision,
//! so the files are the whole state of the schedule: a restarted server goes on with it.

mod files;

use std::{
    fs::{self, File, TryLockError},
    io::{self, BufWriter},
    path::{Component, Path, PathBuf, absolute},
    sync::Arc,
    time::{Duration, SystemTime},
};

use thiserror::Error;
use tokio::{
    runtime::Handle,
    time::{MissedTickBehavior, interval},
};
use tracing::{error, info};
use wayfold_proto::{snapshot::FileWriter, v1};

use self::files::{STAMP_BYTES, SUFFIX, prune, snapshots, stamp};
use crate::{
    config::SnapshotConfig,
    log::make_directory,
    observe::Metrics,
    registry::{Hosted, IndexState},
    service::{self, Call, Service},
    watermark::{self, Watermark, WatermarkExceeded},
};

/// The longest time between two checks for indices whose snapshot is due.
const MAX_CHECK_INTERVAL: Duration = Duration::from_secs(60);

/// The file whose lock the server holds: two servers would take each other's snapshots for their own.
const LOCK: &str = ".lock";

/// The name of a snapshot that is not whole yet.
const UNFINISHED: &str = ".unfinished.part";

/// The snapshots cannot be written where the settings say.
#[derive(Debug, Error)]
pub enum SnapshotsError {
    /// The directory cannot be made or written.
    #[error(
        "cannot write snapshots to {}: {source}\n  \
         set snapshot.dir to a directory that the server may write, or to \"off\"",
        directory.display()
    )]
    Directory {
        /// The directory.
        directory: PathBuf,
        /// The problem.
        source: io::Error,
    },
    /// Another server writes its snapshots there.
    #[error(
        "another server writes its snapshots to {}: set snapshot.dir to a directory of its own",
        directory.display()
    )]
    InUse {
        /// The directory.
        directory: PathBuf,
    },
    /// The directory is that of the indices, in it, or around it.
    #[error(
        "snapshot.dir is {}, which is in data.dir or holds it: set it to a directory of its own",
        directory.display()
    )]
    InData {
        /// The directory.
        directory: PathBuf,
    },
}

/// The reason why an index has no new snapshot.
#[derive(Debug, Error)]
enum Failure {
    #[error("{0}")]
    Refused(#[from] service::Error),
    #[error("cannot write {}: {source}", path.display())]
    File { path: PathBuf, source: io::Error },
    #[error("no room for {}: {full}", path.display())]
    Full {
        path: PathBuf,
        full: WatermarkExceeded,
    },
    #[error("the server stops")]
    Stopping,
}

/// The schedule, and the directory of the snapshots.
pub(crate) struct Schedule {
    directory: PathBuf,
    every: Duration,
    keep: usize,
    disk: Option<Arc<Watermark>>,
    _lock: File,
}

impl Schedule {
    /// The schedule of the settings, if there is one, for indices in `data`. Makes the directory.
    pub(crate) fn open(
        config: &SnapshotConfig,
        data: Option<&Path>,
        min_free_bytes: u64,
    ) -> Result<Option<Self>, SnapshotsError> {
        let Some(directory) = config.directory() else {
            return Ok(None);
        };
        if data.is_some_and(|data| is_within(directory, data) || is_within(data, directory)) {
            return Err(SnapshotsError::InData {
                directory: directory.to_owned(),
            });
        }
        let failed = |source| SnapshotsError::Directory {
            directory: directory.to_owned(),
            source,
        };
        let lock = make_directory(directory).and_then(|()| File::create(directory.join(LOCK)));
        let lock = lock.map_err(failed)?;
        lock.try_lock().map_err(|error| match error {
            TryLockError::WouldBlock => SnapshotsError::InUse {
                directory: directory.to_owned(),
            },
            TryLockError::Error(source) => failed(source),
        })?;
        Ok(Some(Self {
            directory: directory.to_owned(),
            every: Duration::from_secs(config.every_seconds),
            keep: config.keep,
            disk: watermark::disk(directory, min_free_bytes),
            _lock: lock,
        }))
    }

    /// Takes every snapshot when it is due, until it is dropped.
    pub(crate) async fn run(self, service: Service, metrics: Metrics) {
        let schedule = Arc::new(self);
        let mut checks = interval(schedule.every.min(MAX_CHECK_INTERVAL));
        checks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            checks.tick().await;
            let (schedule, service) = (Arc::clone(&schedule), service.clone());
            let (metrics, runtime) = (metrics.clone(), Handle::current());
            let look = move || schedule.take_due(&service, &metrics, &runtime, SystemTime::now());
            if let Err(error) = tokio::task::spawn_blocking(look).await {
                error!(%error, "the look for snapshots that are due failed; this is a bug");
            }
        }
    }

    /// Takes the snapshots that are due. Blocks.
    fn take_due(&self, service: &Service, metrics: &Metrics, runtime: &Handle, now: SystemTime) {
        for (index, state) in service.listed() {
            if !service.is_serving() {
                return;
            }
            // The lists of the indices and the log tell of damaged ones.
            let IndexState::Hosted(hosted) = state else {
                continue;
            };
            match self.take_one(service, runtime, &hosted, now) {
                Ok(None) => {}
                Ok(Some(file)) => {
                    metrics.count_snapshot(true);
                    info!(index, file = %file.display(), "snapshot written");
                }
                Err(Failure::Stopping) => return,
                Err(error) => {
                    metrics.count_snapshot(false);
                    error!(index, %error, "no snapshot; the server tries again");
                }
            }
        }
    }

    /// Takes the snapshot of one index if it is due, and returns its file.
    fn take_one(
        &self,
        service: &Service,
        runtime: &Handle,
        hosted: &Hosted,
        now: SystemTime,
    ) -> Result<Option<PathBuf>, Failure> {
        let directory = self.directory.join(hosted.name());
        let failed = |source| Failure::File {
            path: directory.clone(),
            source,
        };
        make_directory(&directory).map_err(failed)?;
        let before = snapshots(&directory).map_err(failed)?;
        let content = format!(
            "-{}-{}{SUFFIX}",
            hosted.uid_text(),
            hosted.published().revision
        );
        if !self.is_due(&before, &content, now) {
            return Ok(None);
        }
        let unfinished = directory.join(UNFINISHED);
        let written = self.write(service, runtime, hosted, &unfinished);
        let (file, content) = match written {
            Ok(written) => written,
            Err(error) => {
                // The next snapshot of an index of the name replaces the file in any case.
                let _ = fs::remove_file(&unfinished);
                return match error {
                    // It was deleted after the list was made.
                    Failure::Refused(service::Error::IndexNotFound { .. }) => Ok(None),
                    error => Err(error),
                };
            }
        };
        let path = directory.join(stamp(now) + &content);
        let finish = || {
            file.sync_all()?;
            fs::rename(&unfinished, &path)?;
            File::open(&directory)?.sync_all()
        };
        finish().map_err(failed)?;
        prune(&directory, hosted.uid_text(), self.keep);
        Ok(Some(path))
    }

    /// True if an index needs a snapshot: none has its content, and the newest one is old enough. A snapshot whose time is
    /// yet to come is no measure: the clock was ahead.
    fn is_due(&self, before: &[String], content: &str, now: SystemTime) -> bool {
        let past = |name: &&String| name[..STAMP_BYTES] <= stamp(now)[..];
        let is_old = |newest: &String| {
            now.checked_sub(self.every)
                .is_none_or(|at| newest[..STAMP_BYTES] <= stamp(at)[..])
        };
        !before.iter().any(|name| name.ends_with(content))
            && before.iter().rfind(past).is_none_or(is_old)
    }

    /// Writes a snapshot, and returns the file with the end of its name.
    fn write(
        &self,
        service: &Service,
        runtime: &Handle,
        hosted: &Hosted,
        path: &Path,
    ) -> Result<(File, String), Failure> {
        let failed = |source| Failure::File {
            path: path.to_owned(),
            source,
        };
        let request = v1::SnapshotIndexRequest {
            index_name: hosted.name().to_owned(),
            ..Default::default()
        };
        // The server itself has every right.
        let begun = runtime.block_on(service.snapshot_index(&Call::default(), request));
        let mut snapshot = begun?;
        let (uid, revision) = snapshot.content()?;
        let content = format!("-{uid}-{revision}{SUFFIX}");
        let file = File::create(path).map_err(failed)?;
        let mut writer = FileWriter::new(BufWriter::new(file));
        while let Some(answer) = runtime.block_on(snapshot.next()) {
            if !service.is_serving() {
                return Err(Failure::Stopping);
            }
            let Some(part) = answer?.part else {
                continue;
            };
            let room = self
                .disk
                .as_ref()
                .map_or(Ok(()), |disk| disk.admit(part.content.len() as u64));
            room.map_err(|full| Failure::Full {
                path: path.to_owned(),
                full,
            })?;
            writer.write(&part).map_err(failed)?;
        }
        let buffered = writer.finish().map_err(failed)?;
        let file = buffered
            .into_inner()
            .map_err(|error| failed(error.into_error()))?;
        Ok((file, content))
    }
}

/// True if `inner` is `outer` or below it.
fn is_within(inner: &Path, outer: &Path) -> bool {
    let [inner, outer] = [inner, outer].map(|path| resolved(path).ok());
    inner
        .zip(outer)
        .is_some_and(|(inner, outer)| inner.starts_with(outer))
}

/// A path without links and `..`. Its end need not exist yet.
fn resolved(path: &Path) -> io::Result<PathBuf> {
    let mut resolved = PathBuf::new();
    for part in absolute(path)?.components() {
        if part == Component::ParentDir {
            resolved.pop();
        } else {
            resolved.push(part);
        }
        // A path that does not exist has no links.
        resolved = resolved.canonicalize().unwrap_or(resolved);
    }
    Ok(resolved)
}

#[cfg(test)]
mod tests;
