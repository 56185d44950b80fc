//! States from files, standard input and the command line, checked against a space row by row.

mod csv;
mod error;
mod literal;
mod npy;
mod place;

use std::path::{Path, PathBuf};

use tokio::sync::mpsc;
use wayfold::Space;

pub(super) use error::InputError;
use place::Place;

/// Where states come from.
#[derive(Clone, Debug)]
pub(super) enum Source {
    /// One state, typed.
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

/// One row of input.
#[derive(Debug)]
pub(super) struct Row {
    /// A state of the space, as it was given.
    pub(super) state: Vec<f64>,
    /// Its id, if a column of ids was named.
    pub(super) id: Option<u64>,
    place: Place,
}

type Rows = Box<dyn Iterator<Item = Result<Row, InputError>> + Send>;

/// The rows of a source, in order, each checked: finite numbers, as many as `space` has coordinates, that make a
/// state. `ids` names the column that holds the ids and is no coordinate.
pub(super) fn rows(source: &Source, space: &Space, ids: Option<&str>) -> Result<Rows, InputError> {
    let rows = match source {
        Source::Literal(text) => literal::rows(text, space)?,
        Source::Stdin => csv::rows("stdin", std::io::stdin(), space, ids)?,
        Source::Csv(path) => csv::rows(&path.display().to_string(), open(path)?, space, ids)?,
        Source::Npy(path) => npy::rows(&path.display().to_string(), open(path)?, space, ids)?,
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
            place: row.place.of(error.coordinate),
            problem: error.reason,
        }),
    }
}

/// All rows of a source, checked whole: also that no id is given twice.
pub(super) struct Table {
    /// The rows' numbers.
    pub(super) states: wayfold::States,
    /// One a row, or none.
    pub(super) ids: Vec<u64>,
}

pub(super) fn table(
    source: &Source,
    space: &Space,
    ids: Option<&str>,
) -> Result<Table, InputError> {
    let mut table = Table {
        states: wayfold::States::new(space.coordinates()),
        ids: Vec::new(),
    };
    let mut lines = std::collections::HashMap::new();
    for row in rows(source, space, ids)? {
        let row = row?;
        if let Some(id) = row.id {
            if let Some(first) = lines.insert(id, row.place.line()) {
                return Err(InputError::TwiceId {
                    place: row.place.of_id(),
                    id,
                    first,
                });
            }
            table.ids.push(id);
        }
        table.states.push(&row.state)?;
    }
    Ok(table)
}

/// The rows of a source, read by a thread of its own as fast as they are taken: who writes a row into a pipe and waits
/// for its answer gets it. At most so many rows wait.
pub(super) fn spawn(rows: Rows, waiting: usize) -> mpsc::Receiver<Result<Row, InputError>> {
    let (sender, receiver) = mpsc::channel(waiting);
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
