//! Printing results.

use std::{
    fmt,
    io::{self, BufWriter, Write},
};

use base64::{Engine, prelude::BASE64_STANDARD};
use clap::ValueEnum;
use serde::{Serialize, Serializer};
use wayfold::Revision;

/// The format of results and errors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    Text,
    Json,
}

/// The destination of results, and their format.
pub(super) struct Output {
    pub(super) format: Format,
    to: Box<dyn Write + Send>,
}

impl Output {
    pub(super) fn stdout(format: Format) -> Output {
        Output::to(format, io::stdout())
    }

    pub(super) fn to(format: Format, to: impl Write + Send + 'static) -> Output {
        Output {
            format,
            to: Box::new(BufWriter::new(to)),
        }
    }

    /// A line of JSON.
    pub(super) fn json(&mut self, value: &impl Serialize) -> io::Result<()> {
        json_line(&mut self.to, value)
    }

    /// A line of text.
    pub(super) fn text(&mut self, line: impl fmt::Display) -> io::Result<()> {
        writeln!(self.to, "{line}")
    }

    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

/// Writes a value as one line of JSON.
pub(super) fn json_line(to: &mut impl Write, value: &impl Serialize) -> io::Result<()> {
    serde_json::to_writer(&mut *to, value)?;
    to.write_all(b"\n")
}

/// An id or a tag in JSON: a number, or from 2^53 up a string, because readers that hold numbers in doubles round them.
#[derive(Clone, Copy, Debug)]
pub(super) struct JsonId(pub(super) u64);

impl Serialize for JsonId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        const FIRST_STRING: u64 = 1 << 53;
        match self.0 {
            FIRST_STRING.. => serializer.collect_str(&self.0),
            id => serializer.serialize_u64(id),
        }
    }
}

/// Ids or tags in JSON.
#[derive(Clone, Copy, Debug)]
pub(super) struct JsonIds<'a>(pub(super) &'a [u64]);

impl Serialize for JsonIds<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(|id| JsonId(*id)))
    }
}

/// A revision in JSON: the number means something only with the uid.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct JsonRevision<'a> {
    uid: &'a str,
    number: u64,
}

impl<'a> JsonRevision<'a> {
    pub(super) fn new(uid: &'a str, number: u64) -> JsonRevision<'a> {
        JsonRevision { uid, number }
    }
}

impl<'a> From<&'a Revision> for JsonRevision<'a> {
    fn from(revision: &'a Revision) -> JsonRevision<'a> {
        JsonRevision::new(&revision.uid, revision.number)
    }
}

/// Numbers separated by commas, each in the fewest digits that read back as the same number.
pub(super) struct Row<'a>(pub(super) &'a [f64]);

impl fmt::Display for Row<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, number) in self.0.iter().enumerate() {
            let comma = if i == 0 { "" } else { "," };
            write!(f, "{comma}{number:?}")?;
        }
        Ok(())
    }
}

/// A payload in JSON: base64, as in the JSON of protobuf.
pub(super) fn json_payload(payload: &[u8]) -> String {
    BASE64_STANDARD.encode(payload)
}

/// A column of a table.
pub(super) struct Column {
    pub(super) name: &'static str,
    /// Numbers are aligned to the right.
    pub(super) right: bool,
    pub(super) cells: Vec<String>,
}

impl Column {
    pub(super) fn new<T: ToString>(
        name: &'static str,
        right: bool,
        cells: impl IntoIterator<Item = T>,
    ) -> Column {
        Column {
            name,
            right,
            cells: cells.into_iter().map(|cell| cell.to_string()).collect(),
        }
    }

    fn padded(&self, text: &str, width: usize) -> String {
        match self.right {
            true => format!("{text:>width$}"),
            false => format!("{text:width$}"),
        }
    }
}

/// A table with a header line, its columns as wide as they need to be.
pub(super) fn table(output: &mut Output, indent: &str, columns: &[Column]) -> io::Result<()> {
    let rows = columns.first().map_or(0, |column| column.cells.len());
    let mut lines = vec![indent.to_owned(); rows + 1];
    for column in columns {
        let cells = || std::iter::once(column.name).chain(column.cells.iter().map(String::as_str));
        let width = cells().map(|cell| cell.chars().count()).max();
        for (line, cell) in lines.iter_mut().zip(cells()) {
            line.push_str(&column.padded(cell, width.unwrap_or(0)));
            line.push_str("  ");
        }
    }
    for line in lines {
        output.text(line.trim_end())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_strings_from_2_to_the_53_up() {
        let ids = [0, (1 << 53) - 1, 1 << 53, (1 << 63) - 1];
        let json = serde_json::to_string(&JsonIds(&ids)).unwrap();
        assert_eq!(
            json,
            r#"[0,9007199254740991,"9007199254740992","9223372036854775807"]"#
        );
    }

    #[test]
    fn rows_read_back_as_the_same_numbers() {
        let row = [0.1, -0.0, 1e150, 5e-324, 1.0 / 3.0, 123456789.0];
        let text = Row(&row).to_string();
        let read: Vec<u64> = text
            .split(',')
            .map(|number| number.parse::<f64>().unwrap().to_bits())
            .collect();
        assert_eq!(read, row.map(f64::to_bits));
    }
}
