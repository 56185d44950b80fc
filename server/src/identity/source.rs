//! The identities of a running server, which follow their file.

use std::{
    fmt, fs, io,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::{Duration, SystemTime},
};

use parking_lot::RwLock;
use prometheus_client::metrics::gauge::Gauge;
use tokio::time::interval;
use tracing::{error, info};

use super::{Caller, ClientCertificate, IdentificationError, TableError, table::Table};

/// The interval at which files are looked at: a revoked identity has its rights for so long at most.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// The identities of the server. Clones share them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Identities {
    /// None: the server has none, and every caller may do everything.
    source: Option<Arc<Source>>,
}

#[derive(Debug)]
struct Source {
    file: PathBuf,
    /// The state of the file before it was first read: a change since then shows.
    first: Stamp,
    table: RwLock<Table>,
    /// The calls that exceeded the quota of their identity.
    excess: AtomicU64,
}

/// A state of a file, by which a change shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp(Option<(SystemTime, u64, InodeStamp)>);

/// The file itself, and the last time at which anything of it changed: a new token has the length of the old one, and copies
/// may keep the time of the content.
#[cfg(unix)]
type InodeStamp = [i64; 4];
#[cfg(not(unix))]
type InodeStamp = ();

impl Stamp {
    /// The state of a file now. A file that cannot be looked at has a state of its own.
    pub(crate) fn of(file: &Path) -> Self {
        let looked = fs::metadata(file)
            .and_then(|it| io::Result::Ok((it.modified()?, it.len(), Self::inode_stamp(&it))));
        Self(looked.ok())
    }

    #[cfg(unix)]
    fn inode_stamp(of: &fs::Metadata) -> InodeStamp {
        use std::os::unix::fs::MetadataExt;
        let (device, number) = (of.dev().cast_signed(), of.ino().cast_signed());
        [device, number, of.ctime(), of.ctime_nsec()]
    }

    #[cfg(not(unix))]
    fn inode_stamp(_: &fs::Metadata) -> InodeStamp {}
}

/// Reads files again whenever their state changes. Files that are wrong change nothing but the gauge.
pub(crate) async fn follow<State: PartialEq, Error: fmt::Display>(
    mut known: State,
    look: impl Fn() -> State,
    read: impl Fn() -> Result<(), Error>,
    is_wrong: Gauge,
    consequence: &str,
) {
    let mut wrong: Option<String> = None;
    let mut checks = interval(CHECK_INTERVAL);
    loop {
        checks.tick().await;
        let now = look();
        let is_changed = now != known;
        // A read may fail for a passing reason that changes no file, such as too many open files: it is repeated.
        if !is_changed && wrong.is_none() {
            continue;
        }
        known = now;
        let error = read().err().map(|error| error.to_string());
        if let Some(error) = &error
            && (is_changed || wrong.as_ref() != Some(error))
        {
            error!(%error, "{consequence}");
        }
        is_wrong.set(error.is_some().into());
        wrong = error;
    }
}

impl Identities {
    /// The identities of a file; none without one.
    pub(crate) fn open(file: Option<&Path>) -> Result<Self, TableError> {
        let Some(file) = file else {
            return Ok(Self::default());
        };
        let first = Stamp::of(file);
        let table = Table::read(file)?;
        info!(file = %file.display(), identities = table.len(), "identities read");
        Ok(Self {
            source: Some(Arc::new(Source {
                file: file.to_owned(),
                first,
                table: RwLock::new(table),
                excess: AtomicU64::new(0),
            })),
        })
    }

    /// True if callers need an identity.
    pub(crate) fn are_required(&self) -> bool {
        self.source.is_some()
    }

    /// The caller with a token, a certificate, or neither. The token counts if there are both.
    pub(crate) fn caller(
        &self,
        token: Option<&[u8]>,
        certificate: Option<&ClientCertificate>,
    ) -> Caller {
        let Some(source) = &self.source else {
            return Caller::Anyone;
        };
        let caller = match (token, certificate) {
            (Some(token), _) => source.table.read().of_token(token),
            (None, Some(certificate)) => source.table.read().of_certificate(certificate),
            (None, None) => Caller::Unknown(IdentificationError::NoCredential),
        };
        if caller.is_excess() {
            source.excess.fetch_add(1, Relaxed);
        }
        caller
    }

    /// The number of calls that exceeded the quota of their identity so far.
    pub(crate) fn excess(&self) -> u64 {
        let source = self.source.as_ref();
        source.map_or(0, |source| source.excess.load(Relaxed))
    }

    /// The caller of a call that another server of the cluster forwards, by the name of its identity. Without one the
    /// server itself calls. One beyond the quota is not counted as refused: that server evaluates it.
    pub(crate) fn forwarded(&self, name: Option<&str>) -> Caller {
        match (&self.source, name) {
            (Some(source), Some(name)) => source.table.read().of_name(name),
            (None, _) | (_, None) => Caller::Anyone,
        }
    }

    /// Reads the file again whenever it changes. A file that is wrong changes nothing but the gauge.
    pub(crate) async fn follow(self, is_wrong: Gauge) {
        let Some(source) = self.source else {
            return;
        };
        let look = || Stamp::of(&source.file);
        let read = || source.read_again();
        let consequence = "the identities stay as they were";
        follow(source.first, look, read, is_wrong, consequence).await;
    }
}

impl Source {
    fn read_again(&self) -> Result<(), TableError> {
        let table = Table::read(&self.file)?;
        let mut current = self.table.write();
        let table = table.succeed(&current);
        info!(file = %self.file.display(), identities = table.len(), "identities read");
        *current = table;
        Ok(())
    }
}

#[cfg(all(test, unix))]
mod tests {
    use std::cell::Cell;

    use tokio::time::timeout;

    use super::*;

    /// The clock of this test moves by itself.
    #[tokio::test(start_paused = true)]
    async fn a_read_that_fails_is_repeated_until_it_succeeds() {
        let (reads, is_wrong) = (Cell::new(0), Gauge::default());
        let read = || {
            reads.set(reads.get() + 1);
            match reads.get() {
                1 | 2 => Err("too many open files"),
                _ => Ok(()),
            }
        };
        let following = follow(0, || 1, read, is_wrong.clone(), "nothing changes");
        timeout(10 * CHECK_INTERVAL, following).await.unwrap_err();
        assert_eq!((reads.get(), is_wrong.get()), (3, 0));
    }

    #[test]
    fn a_file_of_the_same_length_and_time_is_another() {
        let directory = tempfile::tempdir().unwrap();
        let [file, next] = ["identities", "next"].map(|name| directory.path().join(name));
        let write = |file: &Path, text: &str| {
            fs::write(file, text).unwrap();
            let opened = fs::File::options().write(true).open(file).unwrap();
            opened.set_modified(SystemTime::UNIX_EPOCH).unwrap();
        };
        write(&file, "old");
        let old = Stamp::of(&file);
        assert_eq!(Stamp::of(&file), old);
        write(&next, "new");
        fs::rename(&next, &file).unwrap();
        assert_ne!(Stamp::of(&file), old);
    }
}
