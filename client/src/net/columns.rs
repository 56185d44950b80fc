//! The columns that stored points and neighbours have in common.

use bytes::Bytes;
use wayfold_proto::v1;

use crate::{Error, Include, States};

/// One entry a point in each column that the request included.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Columns {
    pub(super) ids: Vec<u64>,
    pub(super) states: Option<States>,
    pub(super) tags: Option<Vec<u64>>,
    /// The numbers of the revisions that stored the states.
    pub(super) stored: Option<Vec<u64>>,
    pub(super) payloads: Option<Vec<Bytes>>,
}

impl Columns {
    /// The columns of an answer, checked.
    pub(super) fn from_message(
        call: &'static str,
        message: v1::Points,
        width: usize,
        include: Include,
    ) -> Result<Columns, Error> {
        let wrong = |problem: &str| Error::protocol(call, problem);
        let found = message.ids.len();
        let states = match include.states {
            true => Some(
                States::from_message(message.states, found, width)
                    .ok_or_else(|| wrong("not a state for each id"))?,
            ),
            false => None,
        };
        let (tags, stored, payloads) = (message.tags, message.revisions, message.payloads);
        if include.tags && tags.len() != found
            || include.revisions && stored.len() != found
            || include.payloads && payloads.len() != found
        {
            return Err(wrong("not a tag, revision or payload for each id"));
        }
        Ok(Columns {
            ids: message.ids,
            states,
            tags: include.tags.then_some(tags),
            stored: include.revisions.then_some(stored),
            payloads: include.payloads.then_some(payloads),
        })
    }

    /// Appends the answer to later rows of the same request.
    pub(super) fn append(&mut self, other: Columns) {
        self.ids.extend(other.ids);
        if let (Some(states), Some(others)) = (&mut self.states, other.states) {
            states.append(others);
        }
        extend(&mut self.tags, other.tags);
        extend(&mut self.stored, other.stored);
        extend(&mut self.payloads, other.payloads);
    }
}

/// Appends a column that both answers have.
fn extend<T>(column: &mut Option<Vec<T>>, other: Option<Vec<T>>) {
    if let (Some(column), Some(other)) = (column, other) {
        column.extend(other);
    }
}
