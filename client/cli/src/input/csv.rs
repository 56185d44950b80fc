//! CSV: a row is one state; a header line is allowed.

use std::{io::Read, sync::Arc};

use csv::{Reader, ReaderBuilder, StringRecord, Trim};
use wayfold::Space;

use super::{
    Columns, InputError, Row, Rows,
    lines::Lines,
    position::{File, InputPosition, RowNumber},
};
use crate::parse;
use wayfold::coordinate_names;

pub(super) fn rows(
    name: &str,
    input: impl Read + Send + 'static,
    space: &Space,
    columns: Columns<'_>,
) -> Result<Rows, InputError> {
    let mut reader = ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(Trim::All)
        .from_reader(Lines::new(input));
    let mut first = StringRecord::new();
    let is_empty = !read(name, &mut reader, &mut first)?;
    let is_named = |column| [columns.ids, columns.tags].contains(&Some(column));
    let has_header = !is_empty && (first.iter().any(is_named) || is_header(&first));
    if let Some(option) = columns.option()
        && !has_header
    {
        return Err(InputError::NoHeader {
            file: name.to_owned(),
            option,
            problem: "the first line is not a header",
        });
    }
    if is_empty {
        return Ok(Box::new(std::iter::empty()));
    }
    let column = |named: Option<&str>| named.map(|column| find(name, &first, column));
    if columns.ids.is_some() && columns.ids == columns.tags {
        return Err(InputError::Format {
            position: name.to_owned(),
            problem: "--ids and --tags name the same column".to_owned(),
        });
    }
    let id_column = column(columns.ids).transpose()?;
    let tag_column = column(columns.tags).transpose()?;
    let is_coordinate = |column: usize| ![id_column, tag_column].contains(&Some(column));
    let mut named = first.iter().enumerate();
    let other_id =
        named.find(|(column, name)| is_coordinate(*column) && name.eq_ignore_ascii_case("id"));
    if has_header && let Some((_, column)) = other_id {
        return Err(InputError::Format {
            position: format!("{name}:1"),
            problem: format!(
                "the column {column} would be a coordinate: say --ids {column} if it is the id"
            ),
        });
    }
    let mut rows = CsvRows {
        file: Arc::new(File {
            name: name.to_owned(),
            coordinates: coordinate_names(space),
            id_column,
            tag_column,
        }),
        space: space.to_string(),
        unread: None,
        reader,
    };
    if has_header {
        rows.check_header(&first)?;
    } else {
        rows.unread = Some(first);
    }
    Ok(Box::new(rows))
}

/// A finite number, or an error that names its position.
pub(super) fn number(text: &str, position: impl Fn() -> String) -> Result<f64, InputError> {
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err(InputError::Number {
            position: position(),
            text: shortened(text),
        }),
    }
}

fn shortened(text: &str) -> String {
    const MAX_CHARS: usize = 40;
    match text.char_indices().nth(MAX_CHARS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}

/// A first line is a header if no field is empty, is a number, or begins as one does. (`nan` counts as a number, so that
/// a file whose first row is bad has no header.)
fn is_header(record: &StringRecord) -> bool {
    let begins_number = |first: char| first.is_ascii_digit() || "+-.".contains(first);
    let is_name = |field: &str| !field.is_empty() && !field.starts_with(begins_number);
    record
        .iter()
        .all(|field| is_name(field) && field.parse::<f64>().is_err())
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

/// Reads the next record that is not an empty line; false at the end. The position of a record is that of its line: the
/// reader has the empty lines before it as a part of it.
fn read(
    file: &str,
    reader: &mut Reader<impl Read>,
    record: &mut StringRecord,
) -> Result<bool, InputError> {
    let found = reader.read_record(record);
    // The reader is behind the LF of the record's last line.
    let last_line = reader.position().line().saturating_sub(1).max(1);
    let found = found.map_err(|error| InputError::Format {
        position: match error.position() {
            Some(_) => format!("{file}:{last_line}"),
            None => file.to_owned(),
        },
        problem: error.to_string(),
    })?;
    let is_one_line = !record.iter().any(|field| field.contains('\n'));
    if let Some(mut position) = record.position().cloned().filter(|_| is_one_line) {
        position.set_line(last_line);
        record.set_position(Some(position));
    }
    Ok(found)
}

struct CsvRows<R> {
    file: Arc<File>,
    space: String,
    /// The first line, if it is not a header.
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
    /// Refuses a header whose columns cannot be the coordinates, or are them in another order.
    fn check_header(&self, header: &StringRecord) -> Result<(), InputError> {
        let position = self.check_width(header)?;
        let names = &self.file.coordinates;
        let column = |coordinate| header.get(self.file.column(coordinate)).unwrap_or_default();
        let found: Vec<&str> = (0..names.len()).map(column).collect();
        let is_other_order = found.iter().zip(names).any(|(found, name)| found != name)
            && names.iter().all(|name| found.contains(&&**name));
        match is_other_order {
            true => Err(InputError::Format {
                position: position.whole(),
                problem: format!(
                    "the columns {} are not in the order of {}: {}",
                    found.join(", "),
                    self.space,
                    names.join(", ")
                ),
            }),
            false => Ok(()),
        }
    }

    /// The position of a record that has a column for each coordinate.
    fn check_width(&self, record: &StringRecord) -> Result<InputPosition, InputError> {
        let position = InputPosition {
            file: Arc::clone(&self.file),
            row: RowNumber::Line(record.position().map_or(0, csv::Position::line)),
        };
        let found = record.len().saturating_sub(self.file.other_columns());
        match found == self.file.coordinates.len() {
            true => Ok(position),
            false => Err(self.wrong_width(&position, found)),
        }
    }

    fn row(&self, record: &StringRecord) -> Result<Row, InputError> {
        let position = self.check_width(record)?;
        let found = self.file.coordinates.len();
        let mut state = Vec::with_capacity(found);
        for coordinate in 0..found {
            let text = record.get(self.file.column(coordinate)).unwrap_or_default();
            state.push(number(text, || position.of(coordinate))?);
        }
        let field = |column: usize| record.get(column).unwrap_or_default();
        let id = |column| {
            parse::id(field(column)).map_err(|_| InputError::Id {
                position: position.of_id(),
                text: shortened(field(column)),
            })
        };
        let tag = |column| {
            parse::tag(field(column)).map_err(|_| InputError::Tag {
                position: position.of_column(column),
                text: shortened(field(column)),
            })
        };
        Ok(Row {
            state,
            id: self.file.id_column.map(id).transpose()?,
            tag: self.file.tag_column.map(tag).transpose()?,
            position,
        })
    }

    fn wrong_width(&self, position: &InputPosition, found: usize) -> InputError {
        InputError::Width {
            position: position.whole(),
            found,
            space: self.space.clone(),
            names: self.file.coordinates.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_of_an_error_is_that_of_an_editor() {
        for (text, expected) in [
            ("0,0\n0,x\n", "file:2:2 (y): \"x\""),
            ("0,0\n\n\n0,x", "file:4:2 (y): \"x\""),
            ("x,y\r\n0,0\r\n\r\n0,x\r\n", "file:4:2 (y): \"x\""),
            ("0,0\r0,x\r0,0\r", "file:2:2 (y): \"x\""),
            ("0,0\n\"\"\n0,0\n", "file:2: 1 numbers"),
            ("0,0\n \n0,0\n", "file:2: 1 numbers"),
            // The quote that opens is wrong, and not the end of the file.
            ("0,0\n\"0,0\n0,0\n0,0\n", "file:2: 1 numbers"),
        ] {
            let rows = plane(text.as_bytes()).unwrap();
            let error = rows.filter_map(Result::err).next().unwrap().to_string();
            assert!(error.starts_with(expected), "{text:?}: {error}");
        }
    }

    #[test]
    fn the_first_line_is_a_header_or_a_row() {
        for (columns, text, expected) in [
            ([None, None], "a,b\n1,2\n", Ok(1)),
            ([None, None], "1,2\n1,2\n", Ok(2)),
            ([None, None], "0x10,a\n1,2\n", Err("file:1:1 (x): \"0x10\"")),
            ([None, None], "a,1_0\n1,2\n", Err("file:1:1 (x): \"a\"")),
            ([None, None], ",\n1,2\n", Err("file:1:1 (x): \"\"")),
            (
                [None, None],
                "Id,x\n1,2\n",
                Err("file:1: the column Id would"),
            ),
            (
                [None, None],
                "id,x,y\n7,1,2\n",
                Err("file:1: the column id would"),
            ),
            (
                [Some("key"), None],
                "key,id,y\n7,1,2\n",
                Err("file:1: the column id would"),
            ),
            ([None, Some("id")], "id,x,y\n7,1,2\n", Ok(1)),
            ([Some(""), None], ",x,y\n7,1,2\n", Ok(1)),
            (
                [Some("a"), Some("a")],
                "a,x,y\n7,1,2\n",
                Err("file: --ids and --tags name"),
            ),
        ] {
            let [ids, tags] = columns;
            let rows = in_plane(text.as_bytes(), Columns { ids, tags });
            let rows = rows.and_then(|rows| rows.collect::<Result<Vec<_>, _>>());
            match (rows, expected) {
                (Ok(rows), Ok(count)) => assert_eq!(rows.len(), count, "{text:?}"),
                (Err(error), Err(problem)) => {
                    let error = error.to_string();
                    assert!(error.starts_with(problem), "{text:?}: {error}");
                }
                (found, _) => panic!("{text:?}: {:?}", found.map(|rows| rows.len())),
            }
        }
    }

    #[test]
    fn a_file_that_cannot_be_read_is_named() {
        let directory = std::fs::File::open(".").unwrap();
        let error = plane(directory).err().unwrap().to_string();
        assert!(error.starts_with("file: "), "{error}");
    }

    fn plane(input: impl Read + Send + 'static) -> Result<Rows, InputError> {
        let columns = Columns {
            ids: None,
            tags: None,
        };
        in_plane(input, columns)
    }

    fn in_plane(
        input: impl Read + Send + 'static,
        columns: Columns<'_>,
    ) -> Result<Rows, InputError> {
        rows("file", input, &"R2".parse().unwrap(), columns)
    }
}
