//! NumPy's `.npy`: `float64` or `float32`, an array of rows, or of one dimension for a single row.

use std::{
    io::{self, BufReader, Read},
    sync::Arc,
};

use npyz::{NpyFile, Order};
use wayfold::Space;

use super::{
    Columns, InputError, Row, Rows,
    position::{File, InputPosition, RowNumber},
};
use wayfold::coordinate_names;

type Array = NpyFile<BufReader<Box<dyn Read + Send>>>;
type Numbers = Box<dyn Iterator<Item = io::Result<f64>> + Send>;

pub(super) fn rows(
    name: &str,
    bytes: impl Read + Send + 'static,
    space: &Space,
    columns: Columns<'_>,
) -> Result<Rows, InputError> {
    if let Some(option) = columns.option() {
        return Err(InputError::NoHeader {
            file: name.to_owned(),
            option,
            problem: "npy has none",
        });
    }
    let wrong = |problem: String| InputError::Format {
        position: name.to_owned(),
        problem,
    };
    let bytes: Box<dyn Read + Send> = Box::new(bytes);
    let array = Array::new(BufReader::new(bytes)).map_err(|error| wrong(error.to_string()))?;
    let (rows, width) = match *array.shape() {
        [width] => (1, width),
        [rows, width] => (rows, width),
        _ => {
            return Err(wrong(format!(
                "an array of shape {:?}, where one of rows is expected",
                array.shape()
            )));
        }
    };
    let width = match usize::try_from(width) {
        Ok(width) if width == space.coordinates() => width,
        width => {
            return Err(InputError::Width {
                position: name.to_owned(),
                found: width.unwrap_or(usize::MAX),
                space: space.to_string(),
                names: coordinate_names(space),
            });
        }
    };
    let by_column = array.order() == Order::Fortran && array.shape().len() == 2;
    let mut numbers = numbers(array).map_err(wrong)?;
    if by_column {
        numbers = transposed(numbers, rows, width).map_err(|error| wrong(error.to_string()))?;
    }
    Ok(Box::new(NpyRows {
        file: File::of_states(name, space),
        numbers,
        next: 0,
        rows,
    }))
}

/// The numbers in the order in which they are stored.
fn numbers(array: Array) -> Result<Numbers, String> {
    let array = match array.try_data::<f64>() {
        Ok(numbers) => return Ok(Box::new(numbers)),
        Err(array) => array,
    };
    match array.try_data::<f32>() {
        Ok(numbers) => Ok(Box::new(numbers.map(|number| number.map(f64::from)))),
        Err(array) => Err(format!(
            "numbers of type {}, where float64 or float32 is expected",
            array.dtype().descr()
        )),
    }
}

/// Numbers that are stored by column, by row. All of them are in memory at once.
fn transposed(numbers: Numbers, rows: u64, width: usize) -> io::Result<Numbers> {
    let stored: Vec<f64> = numbers.collect::<io::Result<_>>()?;
    let rows = usize::try_from(rows)
        .ok()
        .filter(|rows| rows.checked_mul(width) == Some(stored.len()));
    let rows = rows.ok_or_else(|| io::Error::from(io::ErrorKind::UnexpectedEof))?;
    let order = (0..rows).flat_map(move |row| (0..width).map(move |column| column * rows + row));
    Ok(Box::new(order.map(move |position| Ok(stored[position]))))
}

struct NpyRows {
    file: Arc<File>,
    numbers: Numbers,
    next: u64,
    rows: u64,
}

impl Iterator for NpyRows {
    type Item = Result<Row, InputError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.next == self.rows {
            return None;
        }
        let position = InputPosition {
            file: Arc::clone(&self.file),
            row: RowNumber::Row(self.next),
        };
        self.next += 1;
        Some(self.row(position))
    }
}

impl NpyRows {
    fn row(&mut self, position: InputPosition) -> Result<Row, InputError> {
        let mut state = Vec::with_capacity(self.file.coordinates.len());
        for coordinate in 0..self.file.coordinates.len() {
            let number = self
                .numbers
                .next()
                .unwrap_or_else(|| Err(io::ErrorKind::UnexpectedEof.into()));
            state.push(number.map_err(|error| InputError::Format {
                position: position.of(coordinate),
                problem: error.to_string(),
            })?);
        }
        Ok(Row {
            state,
            id: None,
            tag: None,
            position,
        })
    }
}
