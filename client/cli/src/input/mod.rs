//! States from files, standard input and the command line, checked row by row against a space.

mod csv;
mod error;
mod lines;
mod literal;
mod npy;
mod position;

use std::path::{Path, PathBuf};

use tokio::sync::mpsc;
use wayfold::Space;

pub(super) use error::InputError;
use position::InputPosition;

/// A source of states.
#[derive(Clone, Debug)]
pub(super) enum Source {
    /// One state on the command line.
    Literal(String),
    /// CSV on standard input.
    Stdin,
    /// A `.npy` file.
    Npy(PathBuf),
    /// Any other file: CSV.
    Csv(PathBuf),
}

impl Source {
    /// The file of this name, or standard input for `-`.
    pub(super) fn file(name: &Path) -> Source {
        let is_npy = name
            .extension()
            .is_some_and(|extension| extension.eq_ignore_ascii_case("npy"));
        match name.to_str() {
            Some("-") => Source::Stdin,
            _ if is_npy => Source::Npy(name.to_owned()),
            _ => Source::Csv(name.to_owned()),
        }
    }
}

/// The columns of a CSV header that are not coordinates.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Columns<'a> {
    pub(super) ids: Option<&'a str>,
    pub(super) tags: Option<&'a str>,
}

impl Columns<'_> {
    /// The first option that needs a CSV header.
    fn option(self) -> Option<&'static str> {
        let ids = self.ids.map(|_| "--ids");
        ids.or(self.tags.map(|_| "--tags"))
    }
}

/// One row of input.
#[derive(Debug)]
pub(super) struct Row {
    /// A state of the space, not in canonical form.
    pub(super) state: Vec<f64>,
    /// Its id, if there is a column of ids.
    pub(super) id: Option<u64>,
    /// Its tag, if there is a column of tags.
    pub(super) tag: Option<u64>,
    position: InputPosition,
}

type Rows = Box<dyn Iterator<Item = Result<Row, InputError>> + Send>;

/// The rows of a source in order. Each is checked: it has as many finite numbers as `space` has coordinates, and they
/// are a state.
pub(super) fn rows(
    source: &Source,
    space: &Space,
    columns: Columns<'_>,
) -> Result<Rows, InputError> {
    let rows = match source {
        Source::Literal(text) => literal::rows(text, space)?,
        Source::Stdin => csv::rows("stdin", std::io::stdin(), space, columns)?,
        Source::Csv(path) => csv::rows(&path.display().to_string(), open(path)?, space, columns)?,
        Source::Npy(path) => npy::rows(&path.display().to_string(), open(path)?, space, columns)?,
    };
    let space = space.clone();
    Ok(Box::new(rows.map(move |row| check(&space, row?))))
}

fn open(path: &Path) -> Result<std::fs::File, InputError> {
    std::fs::File::open(path).map_err(|source| InputError::Open {
        file: path.display().to_string(),
        source,
    })
}

fn check(space: &Space, row: Row) -> Result<Row, InputError> {
    match space.canonicalize(&mut row.state.clone()) {
        Ok(()) => Ok(row),
        Err(error) => Err(InputError::State {
            position: row.position.of(error.coordinate),
            problem: error.reason,
        }),
    }
}

/// All rows of a source. No id is in it twice.
pub(super) struct Table {
    /// One state a row.
    pub(super) states: wayfold::States,
    /// One id a row, or none at all.
    pub(super) ids: Vec<u64>,
    /// One tag a row, or none at all.
    pub(super) tags: Vec<u64>,
}

pub(super) fn table(
    source: &Source,
    space: &Space,
    columns: Columns<'_>,
) -> Result<Table, InputError> {
    let mut table = Table {
        states: wayfold::States::new(space.coordinates()),
        ids: Vec::new(),
        tags: Vec::new(),
    };
    let mut lines = std::collections::HashMap::new();
    for row in rows(source, space, columns)? {
        let row = row?;
        if let Some(id) = row.id {
            if let Some(first) = lines.insert(id, row.position.line()) {
                return Err(InputError::TwiceId {
                    position: row.position.of_id(),
                    id,
                    first,
                });
            }
            table.ids.push(id);
        }
        table.tags.extend(row.tag);
        table.states.push(&row.state)?;
    }
    Ok(table)
}

/// Reads rows on a thread of their own, so that a row in a pipe is answered before the next one is written. At most
/// `capacity` rows wait.
pub(super) fn spawn(rows: Rows, capacity: usize) -> mpsc::Receiver<Result<Row, InputError>> {
    let (sender, receiver) = mpsc::channel(capacity);
    std::thread::spawn(move || {
        for row in rows {
            let failed = row.is_err();
            if sender.blocking_send(row).is_err() || failed {
                return;
            }
        }
    });
    receiver
}
