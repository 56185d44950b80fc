//! The file of a report. It is opened before the run, so that no run ends without a place for its report.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
};

use crate::{atomic_file, load::error::LoadError};

pub(crate) struct ReportFile {
    path: PathBuf,
    /// A file in the same directory, which is removed unless the report is written.
    temporary: tempfile::NamedTempFile,
}

impl ReportFile {
    pub(crate) fn open(path: &Path) -> Result<ReportFile, LoadError> {
        let failed = |source| LoadError::Report {
            path: path.to_owned(),
            source,
        };
        if fs::metadata(path).is_ok_and(|found| !found.is_file()) {
            return Err(failed(io::Error::other("it is not a regular file")));
        }
        // The file behind a symbolic link is replaced, not the link.
        let target = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        let directory = match target.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        let temporary = atomic_file::temporary_file(directory).map_err(failed)?;
        Ok(ReportFile {
            path: target,
            temporary,
        })
    }

    /// Writes the report under its name, in the place of an older one.
    pub(crate) fn write(mut self, page: &str) -> Result<PathBuf, LoadError> {
        let written = self.temporary.write_all(page.as_bytes());
        let persisted = written.and_then(|()| {
            let persisted = self.temporary.persist(&self.path);
            persisted.map_err(|error| error.error)
        });
        match persisted {
            Ok(_) => Ok(self.path),
            Err(source) => Err(LoadError::ReportLost {
                path: self.path,
                source,
            }),
        }
    }
}
