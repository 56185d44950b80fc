//! One state, typed: `--state 0.1,0.2`.

use std::sync::Arc;

use wayfold::Space;

use super::{
    InputError, Row, Rows,
    place::{File, Place},
};
use wayfold::coordinate_names;

pub(super) fn rows(text: &str, space: &Space) -> Result<Rows, InputError> {
    let file = Arc::new(File {
        name: "--state".to_owned(),
        coordinates: coordinate_names(space),
        id_column: None,
    });
    let place = Place::Flag { file };
    let mut state = Vec::with_capacity(space.coordinates());
    for (coordinate, number) in text.split(',').enumerate() {
        state.push(super::csv::number(number.trim(), || place.of(coordinate))?);
    }
    if state.len() != space.coordinates() {
        return Err(InputError::Width {
            place: place.whole(),
            found: state.len(),
            space: space.to_string(),
            names: coordinate_names(space),
            hint: "",
        });
    }
    let row = Row {
        state,
        id: None,
        place,
    };
    Ok(Box::new(std::iter::once(Ok(row))))
}
