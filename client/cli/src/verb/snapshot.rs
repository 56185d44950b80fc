//! `wayfold snapshot`

use std::{
    io::{self, IsTerminal, Write},
    path::{Path, PathBuf},
};

use indicatif::HumanBytes;
use serde::Serialize;

use crate::{
    Context, atomic_file,
    failure::Failure,
    output::{Format, JsonRevision},
    progress,
};
use wayfold::{Snapshot, SnapshotHeader, SnapshotWriter};

const EXAMPLES: &str = "\
Examples:
  wayfold snapshot arm arm.snapshot
  wayfold snapshot arm - | ssh far wayfold restore arm -

The file holds the space, every point of one revision with its id, state, tag, payload and revision,
the writer sessions, and checksums over all of it. Reads and writes of the index continue meanwhile. The file gets its
name once it is whole and on disk; `wayfold restore NAME FILE` creates an index from it.";

/// Writes a whole index at one revision to a file, as a backup or for another server
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
    space_text: String,
    point_count: u64,
    revision: JsonRevision<'a>,
    bytes: u64,
}

pub(crate) async fn snapshot(args: SnapshotArgs, context: &mut Context) -> Result<(), Failure> {
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
    let snapshot = context.index(&args.name).await?.snapshot().await?;
    if to_stdout {
        // A broken pipe is a failure here, because the reader has not got the whole snapshot.
        let failed = |source| Failure::File {
            path: "standard output".into(),
            source,
        };
        write(snapshot, io::stdout(), &failed).await?;
        return Ok(());
    }
    let header = snapshot.header().clone();
    let failed = |source| Failure::File {
        path: args.file.clone(),
        source,
    };
    let ((), bytes) = atomic_file::write(&args.file, args.force, async |file| {
        write(snapshot, file, &failed).await
    })
    .await?;
    report(context, &header, bytes, &args.file)
}

async fn write(
    mut snapshot: Snapshot,
    to: impl Write,
    failed: &impl Fn(io::Error) -> Failure,
) -> Result<(), Failure> {
    let bar = progress::bar(Some(snapshot.header().point_count), "reading", false);
    let mut file = SnapshotWriter::new(io::BufWriter::new(to));
    while let Some(part) = snapshot.next().await? {
        file.write(&part).map_err(failed)?;
        bar.inc(part.points() as u64);
    }
    file.finish().map_err(failed)?;
    bar.finish_and_clear();
    Ok(())
}

fn report(
    context: &mut Context,
    header: &SnapshotHeader,
    bytes: u64,
    path: &Path,
) -> Result<(), Failure> {
    match context.output.format {
        Format::Json => context.output.json(&Written {
            name: &header.name,
            space_text: header.space.to_string(),
            point_count: header.point_count,
            revision: JsonRevision::new(&header.uid, header.revision),
            bytes,
        })?,
        Format::Text => context.output.text(format_args!(
            "{} points of {} at revision {} written to {}, {}",
            header.point_count,
            header.space,
            header.revision,
            path.display(),
            HumanBytes(bytes)
        ))?,
    }
    Ok(())
}
