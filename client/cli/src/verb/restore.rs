//! `wayfold restore`

use std::{
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
};

use futures_util::StreamExt;

use super::index_info::InfoLine;
use crate::{Context, failure::Failure, output::Format, progress};
use wayfold::{Error, SnapshotError, SnapshotReader};

const EXAMPLES: &str = "\
Examples:
  wayfold restore arm arm.snapshot
  wayfold --server far:50051 restore arm-2 arm.snapshot

The index has the points, ids, tags, payloads, revisions and writer sessions of the snapshot, and a uid
of its own. The server checks the file while it reads it, and creates the index at the end: a refusal of
the file or of the name leaves nothing. After any other failure, or an interrupt at the end, the index may
be there, whole: `wayfold info NAME` says so.";

/// Creates an index from a snapshot
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct RestoreArgs {
    /// The index to create; no index may have this name
    name: String,
    /// The file that `wayfold snapshot` wrote, or - for standard input
    #[arg(value_name = "FILE")]
    file: PathBuf,
}

pub(crate) async fn restore(args: RestoreArgs, context: &mut Context) -> Result<(), Failure> {
    let (name, file): (_, Box<dyn Read + Send>) = match args.file == Path::new("-") {
        true => ("stdin".to_owned(), Box::new(io::stdin())),
        false => {
            let name = args.file.display().to_string();
            let file = File::open(&args.file).map_err(|source| Failure::Snapshot {
                file: name.clone(),
                source: SnapshotError::Io(source),
            })?;
            (name, Box::new(file))
        }
    };
    let bad = |source| Failure::Snapshot {
        file: name.clone(),
        source,
    };
    let snapshot = SnapshotReader::new(file).map_err(bad)?;
    let bar = progress::bar(Some(snapshot.header().point_count), "restoring", false);
    let sent = bar.clone();
    let parts = snapshot.into_stream().inspect(move |part| {
        sent.inc(part.as_ref().map_or(0, |part| part.points() as u64));
    });
    let restored = context.client.restore(&args.name, parts).await;
    let index = match restored {
        Err(Error::Snapshot(source)) => return Err(bad(source)),
        restored => restored?,
    };
    bar.finish_and_clear();
    let info = index.info().await;
    let index = info.map_err(|error| Failure::Stopped {
        done: format!("{} is restored", args.name),
        source: Box::new(error.into()),
    })?;
    match context.output.format {
        Format::Json => context.output.json(&InfoLine::of(&index))?,
        Format::Text => context.output.text(format_args!(
            "restored {}: {} points of {} at revision {} (uid {})",
            index.name, index.point_count, index.space, index.revision.number, index.revision.uid
        ))?,
    }
    Ok(())
}
