//! CSV: a row is one state; a header line is allowed.

use std::{io::Read, sync::Arc};

use csv::{Reader, ReaderBuilder, StringRecord, Trim};
use wayfold::Space;

use super::{
    InputError, Row, Rows,
    place::{File, Place},
};
use crate::parse;
use wayfold::coordinate_names;

pub(super) fn rows(
    name: &str,
    input: impl Read + Send + 'static,
    space: &Space,
    ids: Option<&str>,
) -> Result<Rows, InputError> {
    let mut reader = ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(Trim::All)
        .from_reader(input);
    let mut first = StringRecord::new();
    if !read(name, &mut reader, &mut first)? {
        return match ids {
            Some(_) => Err(no_header(name)),
            None => Ok(Box::new(std::iter::empty())),
        };
    }
    let has_header = ids.is_some() || is_header(&first);
    let id_column = match ids {
        None => None,
        Some(_) if !is_header(&first) => return Err(no_header(name)),
        Some(column) => Some(find(name, &first, column)?),
    };
    let rows = CsvRows {
        file: Arc::new(File {
            name: name.to_owned(),
            coordinates: coordinate_names(space),
            id_column,
        }),
        space: space.to_string(),
        names_id: has_header
            && id_column.is_none()
            && first.iter().any(|column| column.eq_ignore_ascii_case("id")),
        unread: if has_header { None } else { Some(first) },
        reader,
    };
    Ok(Box::new(rows))
}

/// A finite number, or where it is not one.
pub(super) fn number(text: &str, place: impl Fn() -> String) -> Result<f64, InputError> {
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err(InputError::Number {
            place: place(),
            text: shortened(text),
        }),
    }
}

fn shortened(text: &str) -> String {
    const MOST: usize = 40;
    match text.char_indices().nth(MOST) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

fn no_header(file: &str) -> InputError {
    InputError::NoIds {
        file: file.to_owned(),
        problem: "the first line is none",
    }
}

/// A first line is a header if nothing in it is a number. (`nan` reads as one: a file may begin with a bad row.)
fn is_header(record: &StringRecord) -> bool {
    record.iter().all(|field| field.parse::<f64>().is_err())
}

fn find(file: &str, header: &StringRecord, column: &str) -> Result<usize, InputError> {
    header
        .iter()
        .position(|name| name == column)
        .ok_or_else(|| InputError::NoColumn {
            file: file.to_owned(),
            column: column.to_owned(),
            columns: header.iter().map(str::to_owned).collect(),
        })
}

/// Reads the next record that is not an empty line; false at the end.
fn read(
    file: &str,
    reader: &mut Reader<impl Read>,
    record: &mut StringRecord,
) -> Result<bool, InputError> {
    reader.read_record(record).map_err(|error| {
        let place = match error.position() {
            Some(position) => format!("{file}:{}", position.line()),
            None => file.to_owned(),
        };
        InputError::Format {
            place,
            problem: error.to_string(),
        }
    })
}

struct CsvRows<R> {
    file: Arc<File>,
    space: String,
    /// Whether the header has a column `id` that nobody named.
    names_id: bool,
    /// The first line, if it was no header.
    unread: Option<StringRecord>,
    reader: Reader<R>,
}

impl<R: Read> Iterator for CsvRows<R> {
    type Item = Result<Row, InputError>;

    fn next(&mut self) -> Option<Self::Item> {
        if let Some(first) = self.unread.take() {
            return Some(self.row(&first));
        }
        let mut record = StringRecord::new();
        match read(&self.file.name, &mut self.reader, &mut record) {
            Ok(true) => Some(self.row(&record)),
            Ok(false) => None,
            Err(error) => Some(Err(error)),
        }
    }
}

impl<R> CsvRows<R> {
    fn row(&self, record: &StringRecord) -> Result<Row, InputError> {
        let place = Place::Line {
            file: Arc::clone(&self.file),
            line: record.position().map_or(0, csv::Position::line),
        };
        let found = record
            .len()
            .saturating_sub(usize::from(self.file.id_column.is_some()));
        if found != self.file.coordinates.len() {
            return Err(self.wrong_width(&place, found));
        }
        let mut state = Vec::with_capacity(found);
        for coordinate in 0..found {
            let text = record.get(self.file.column(coordinate)).unwrap_or_default();
            state.push(number(text, || place.of(coordinate))?);
        }
        let id = match self.file.id_column {
            None => None,
            Some(column) => {
                let text = record.get(column).unwrap_or_default();
                let id = parse::id(text).map_err(|_| InputError::Id {
                    place: place.of_id(),
                    text: shortened(text),
                })?;
                Some(id)
            }
        };
        Ok(Row { state, id, place })
    }

    fn wrong_width(&self, place: &Place, found: usize) -> InputError {
        let one_too_many = found == self.file.coordinates.len() + 1;
        InputError::Width {
            place: place.whole(),
            found,
            space: self.space.clone(),
            names: self.file.coordinates.clone(),
            hint: match self.names_id && one_too_many {
                true => "; is one column the id? Then say --ids id",
                false => "",
            },
        }
    }
}
