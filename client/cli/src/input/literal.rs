//! One state on the command line: `--state 0.1,0.2`.

use wayfold::Space;

use super::{
    InputError, Row, Rows,
    position::{File, InputPosition, RowNumber},
};
use wayfold::coordinate_names;

pub(super) fn rows(text: &str, space: &Space) -> Result<Rows, InputError> {
    let file = File::of_states("--state", space);
    let position = InputPosition {
        file,
        row: RowNumber::Flag,
    };
    let mut state = Vec::with_capacity(space.coordinates());
    for (coordinate, number) in text.split(',').enumerate() {
        state.push(super::csv::number(number.trim(), || {
            position.of(coordinate)
        })?);
    }
    if state.len() != space.coordinates() {
        return Err(InputError::Width {
            position: position.whole(),
            found: state.len(),
            space: space.to_string(),
            names: coordinate_names(space),
        });
    }
    let row = Row {
        state,
        id: None,
        tag: None,
        position,
    };
    Ok(Box::new(std::iter::once(Ok(row))))
}
