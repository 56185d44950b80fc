//! States in columns, as they travel.

use std::ops::Range;

use wayfold_index::Space;
use wayfold_proto::v1;

use crate::{Error, State, layout, state};

/// States of one space, one row after the other: `len` rows of `width` numbers.
///
/// ```
/// use wayfold::States;
///
/// let mut states = States::new(3);
/// states.push([0.0, 1.0, 3.1])?;
/// assert!(states.push([0.0, 1.0]).is_err());
/// assert_eq!(states.row(0), [0.0, 1.0, 3.1]);
/// # Ok::<(), wayfold::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct States {
    width: usize,
    coordinates: Vec<f64>,
}

impl States {
    /// No states yet, of `width` numbers each.
    pub fn new(width: usize) -> States {
        States {
            width,
            coordinates: Vec::new(),
        }
    }

    /// The given states, checked against the space in their width and, where the type knows it, in their layout.
    /// The server checks the values of the numbers.
    ///
    /// # Errors
    /// [`Error::Width`] or [`Error::Layout`].
    pub fn collect<S: State>(
        space: &Space,
        states: impl IntoIterator<Item = S>,
    ) -> Result<States, Error> {
        state::check_layout::<S>(space, &layout::coordinates(space))?;
        let mut collected = States::new(space.coordinates());
        for state in states {
            collected.push(state)?;
        }
        Ok(collected)
    }

    /// Appends a state.
    ///
    /// # Errors
    /// [`Error::Width`], and nothing is appended.
    pub fn push(&mut self, state: impl State) -> Result<(), Error> {
        let before = self.coordinates.len();
        state.write(&mut self.coordinates);
        let found = self.coordinates.len() - before;
        if found == self.width {
            return Ok(());
        }
        self.coordinates.truncate(before);
        Err(Error::Width {
            row: self.len(),
            expected: self.width,
            found,
        })
    }

    /// The number of states.
    pub fn len(&self) -> usize {
        self.coordinates.len().checked_div(self.width).unwrap_or(0)
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.coordinates.is_empty()
    }

    /// The number of coordinates of a state.
    pub fn width(&self) -> usize {
        self.width
    }

    /// The numbers of state `row`.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn row(&self, row: usize) -> &[f64] {
        &self.coordinates[row * self.width..(row + 1) * self.width]
    }

    /// The numbers of each state.
    pub fn iter(&self) -> std::slice::ChunksExact<'_, f64> {
        self.coordinates.chunks_exact(self.width.max(1))
    }

    /// All numbers, row after row.
    pub fn coordinates(&self) -> &[f64] {
        &self.coordinates
    }

    pub(crate) fn to_message(&self, rows: Range<usize>) -> v1::States {
        v1::States {
            // Requests are divided long before.
            row_count: u32::try_from(rows.len()).unwrap_or(u32::MAX),
            coordinates: self.coordinates[rows.start * self.width..rows.end * self.width].to_vec(),
        }
    }

    /// The rows of an answer; `None` unless there are `rows` rows of `width` numbers each.
    pub(crate) fn from_message(
        message: Option<v1::States>,
        rows: usize,
        width: usize,
    ) -> Option<States> {
        let message = message.unwrap_or_default();
        let fits = message.row_count as usize == rows
            && Some(message.coordinates.len()) == rows.checked_mul(width);
        fits.then_some(States {
            width,
            coordinates: message.coordinates,
        })
    }

    pub(crate) fn append(&mut self, mut other: States) {
        self.coordinates.append(&mut other.coordinates);
    }
}

impl<'a> IntoIterator for &'a States {
    type Item = &'a [f64];
    type IntoIter = std::slice::ChunksExact<'a, f64>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}
