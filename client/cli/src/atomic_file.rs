//! Writing a file whole or not at all.

use std::{
    fs::{self, File},
    io,
    path::Path,
};

use crate::{failure::Failure, interrupt};

/// Writes a file under a temporary name in the directory of `path`, and renames it to `path` once it is whole and on
/// disk. An error or a signal removes it, and leaves a file that has the name as it was. Returns what `write` returns,
/// and the length in bytes.
pub(super) async fn write<T>(
    path: &Path,
    replace: bool,
    write: impl AsyncFnOnce(File) -> Result<T, Failure>,
) -> Result<(T, u64), Failure> {
    let failed = |source| Failure::File {
        path: path.to_owned(),
        source,
    };
    // The file behind a symbolic link is replaced, not the link.
    let target = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let directory = match target.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    };
    // The process listens before the temporary file exists, so that no signal leaves it behind.
    let interrupted = interrupt::listen().map_err(failed)?;
    let temporary = temporary_file(directory).map_err(failed)?;
    let file = temporary.as_file().try_clone().map_err(failed)?;
    let value = tokio::select! {
        written = write(file) => written?,
        () = interrupted => return Err(Failure::Interrupted),
    };
    temporary.as_file().sync_all().map_err(failed)?;
    let bytes = temporary.as_file().metadata().map_err(failed)?.len();
    if let Ok(replaced) = target.metadata() {
        let permissions = replaced.permissions();
        temporary
            .as_file()
            .set_permissions(permissions)
            .map_err(failed)?;
    }
    let renamed = match replace {
        true => temporary.persist(&target),
        false => temporary.persist_noclobber(&target),
    };
    renamed.map_err(|error| match error.error.kind() {
        io::ErrorKind::AlreadyExists => Failure::Exists {
            path: path.to_owned(),
        },
        _ => failed(error.error),
    })?;
    // The name reaches the disk with the directory; not every system can open a directory.
    if let Ok(directory) = fs::File::open(directory) {
        directory.sync_all().map_err(failed)?;
    }
    Ok((value, bytes))
}

/// A file that is removed when it is dropped, with the permissions of a new file.
pub(super) fn temporary_file(directory: &Path) -> io::Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".wayfold-").suffix(".part");
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(directory)
}
