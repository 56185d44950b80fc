//! Printing results.

use std::{
    fmt,
    io::{self, BufWriter, Write},
};

use clap::ValueEnum;
use serde::{Serialize, Serializer};

/// How results are printed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    Text,
    Json,
}

/// Where results are printed, and how.
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
        serde_json::to_writer(&mut self.to, value)?;
        self.to.write_all(b"\n")
    }

    /// A line of text.
    pub(super) fn text(&mut self, line: impl fmt::Display) -> io::Result<()> {
        writeln!(self.to, "{line}")
    }

    pub(super) fn flush(&mut self) -> io::Result<()> {
        self.to.flush()
    }
}

/// An id or a tag in JSON: a number, or from 2^53 up a string, as readers that hold numbers in doubles cut them.
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

/// Several of them.
#[derive(Clone, Copy, Debug)]
pub(super) struct JsonIds<'a>(pub(super) &'a [u64]);

impl Serialize for JsonIds<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(|id| JsonId(*id)))
    }
}

/// Numbers with commas between, each in the fewest digits that read back as the same number.
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

/// The neighbours of one state as a table, a line each.
pub(super) fn neighbor_table(
    output: &mut Output,
    ids: &[u64],
    distances: &[f64],
) -> io::Result<()> {
    let width = ids
        .iter()
        .max()
        .map_or(0, |id| id.to_string().len())
        .max("id".len());
    if !ids.is_empty() {
        output.text(format_args!("  {:>width$}  distance", "id"))?;
    }
    for (id, distance) in ids.iter().zip(distances) {
        output.text(format_args!("  {id:>width$}  {distance:?}"))?;
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
