//! `wayfold snapshot`

use std::{
    fs,
    io::{self, IsTerminal, Write},
    path::{Path, PathBuf},
};

use indicatif::HumanBytes;
use serde::Serialize;
use tempfile::NamedTempFile;

use crate::{Session, failure::Failure, interrupt, output::Format, progress};
use wayfold::{Snapshot, SnapshotHeader, SnapshotWriter};

const EXAMPLES: &str = "\
Examples:
  wayfold snapshot arm arm.snapshot
  wayfold snapshot arm - | ssh far wayfold restore arm -

The file holds the space, and every point of one revision with its id, state, tag, payload and
revisions, and checksums over all of it. Writers and readers of the index go on meanwhile. The file
gets its name once it is whole and on disk; `wayfold restore NAME FILE` makes an index of it.";

/// Writes all of an index, at one revision, into a file, as a backup or for another server
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct SnapshotArgs {
    /// The index
    name: String,
    /// The file to write, or - for standard output
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Replace the file if it exists
    #[arg(long)]
    force: bool,
}

#[derive(Serialize)]
struct Written<'a> {
    name: &'a str,
    space: String,
    points: u64,
    revision: u64,
    uid: &'a str,
    bytes: u64,
}

pub(crate) async fn snapshot(args: SnapshotArgs, session: &mut Session) -> Result<(), Failure> {
    let to_stdout = args.file == Path::new("-");
    if to_stdout && io::stdout().is_terminal() {
        return Err(Failure::Terminal);
    }
    if !to_stdout && let Ok(found) = args.file.metadata() {
        if !found.is_file() {
            return Err(Failure::NoFile { path: args.file });
        }
        if !args.force {
            return Err(Failure::Exists { path: args.file });
        }
    }
    let snapshot = session.index(&args.name).await?.snapshot().await?;
    if to_stdout {
        // Whoever stops reading has not got a snapshot: a broken pipe is no success here.
        let failed = |source| Failure::File {
            path: "standard output".into(),
            source,
        };
        write(snapshot, io::stdout(), &failed).await?;
        return Ok(());
    }
    let header = snapshot.header().clone();
    let bytes = keep(snapshot, &args).await?;
    tell(session, &header, bytes, &args.file)
}

/// Writes the file under another name beside its own, which it gets at the end; tells its length.
async fn keep(snapshot: Snapshot, args: &SnapshotArgs) -> Result<u64, Failure> {
    let failed = |source| Failure::File {
        path: args.file.clone(),
        source,
    };
    let directory = match args.file.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    };
    // Before there is a file: it goes with the command that is interrupted.
    let interrupted = interrupt::listen().map_err(failed)?;
    let mut file = unnamed(directory).map_err(failed)?;
    tokio::select! {
        written = write(snapshot, file.as_file_mut(), &failed) => { written?; }
        () = interrupted => return Err(Failure::Interrupted),
    }
    file.as_file().sync_all().map_err(failed)?;
    let bytes = file.as_file().metadata().map_err(failed)?.len();
    let named = match args.force {
        true => file.persist(&args.file),
        false => file.persist_noclobber(&args.file),
    };
    named.map_err(|error| match error.error.kind() {
        io::ErrorKind::AlreadyExists => Failure::Exists {
            path: args.file.clone(),
        },
        _ => failed(error.error),
    })?;
    // So that the name too is on disk; not every system lets a directory be opened.
    if let Ok(directory) = fs::File::open(directory) {
        directory.sync_all().map_err(failed)?;
    }
    Ok(bytes)
}

/// A file that is removed when it is dropped, and that others may read as they may read new files.
fn unnamed(directory: &Path) -> io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".wayfold-").suffix(".snapshot.part");
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(directory)
}

async fn write(
    mut snapshot: Snapshot,
    to: impl Write,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<(), Failure> {
    let bar = progress::bar(Some(snapshot.header().points), "reading", false);
    let mut file = SnapshotWriter::new(io::BufWriter::new(to)).map_err(failed)?;
    while let Some(part) = snapshot.next().await? {
        file.write(&part).map_err(failed)?;
        bar.inc(part.points() as u64);
    }
    file.finish().map_err(failed)?;
    bar.finish_and_clear();
    Ok(())
}

fn tell(
    session: &mut Session,
    header: &SnapshotHeader,
    bytes: u64,
    path: &Path,
) -> Result<(), Failure> {
    match session.output.format {
        Format::Json => session.output.json(&Written {
            name: &header.name,
            space: header.space.to_string(),
            points: header.points,
            revision: header.revision,
            uid: &header.uid,
            bytes,
        })?,
        Format::Text => session.output.text(format_args!(
            "{} points of {} at revision {} written to {}, {}",
            header.points,
            header.space,
            header.revision,
            path.display(),
            HumanBytes(bytes)
        ))?,
    }
    Ok(())
}
