//! Revisions of indices.

use std::{fmt, sync::Arc};

use wayfold_proto::v1;

use crate::{Code, Error, Refusal};

/// A revision of an index: the number of records that its log had. The number means something only with the uid.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct Revision {
    /// Identifies the history that the number counts. The server makes a new uid when the history may differ: the index
    /// was deleted and created again, was restored, or lost mutations that were not synced.
    pub uid: Arc<str>,
    /// The number of records that the log had.
    pub number: u64,
}

impl Revision {
    /// Revision `number` of the history that `uid` identifies.
    pub fn new(uid: impl Into<Arc<str>>, number: u64) -> Revision {
        Revision {
            uid: uid.into(),
            number,
        }
    }

    pub(crate) fn to_message(&self) -> v1::Revision {
        v1::Revision {
            uid: self.uid.to_string(),
            number: self.number,
        }
    }

    /// The revision of an answer, which must have one. Its uid is shared with `known` if it is the same.
    pub(crate) fn from_message(
        call: &'static str,
        message: Option<v1::Revision>,
        known: &Arc<str>,
    ) -> Result<Revision, Error> {
        let message = message.ok_or_else(|| Error::protocol(call, "it names no revision"))?;
        let uid = match *message.uid == **known {
            true => Arc::clone(known),
            false => message.uid.into(),
        };
        Ok(Revision::new(uid, message.number))
    }

    /// Refuses a revision of another uid than `found`, as the server does.
    pub(crate) fn check_uid(&self, found: &str) -> Result<(), Error> {
        if *self.uid == *found {
            return Ok(());
        }
        let metadata = [("requested", &*self.uid), ("found", found)];
        let metadata = metadata.map(|(key, value)| (key.to_owned(), value.to_owned()));
        Err(Error::Refused(Box::new(Refusal {
            code: Code::FailedPrecondition,
            message: format!(
                "the index has the uid {found}, not {}: it was created again, or restored",
                self.uid
            ),
            reason: "UID_MISMATCH".to_owned(),
            metadata: metadata.into(),
            fields: Vec::new(),
            ids: Vec::new(),
            retry_after: None,
            earlier: None,
        })))
    }
}

impl fmt::Display for Revision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {}", self.number, self.uid)
    }
}

/// The revisions that the rows of an answer were read at: one, unless the read was divided among several calls.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RowRevisions {
    uid: Arc<str>,
    /// The end of each run of rows of one revision, and its number.
    runs: Vec<(usize, u64)>,
}

impl RowRevisions {
    pub(crate) fn one(rows: usize, revision: Revision) -> RowRevisions {
        RowRevisions {
            uid: revision.uid,
            runs: vec![(rows, revision.number)],
        }
    }

    /// Appends the runs of a later part of the same read.
    pub(crate) fn append(&mut self, other: RowRevisions) {
        let rows = self.runs.last().map_or(0, |(end, _)| *end);
        for (end, number) in other.runs {
            match self.runs.last_mut() {
                Some(last) if last.1 == number => last.0 = rows + end,
                _ => self.runs.push((rows + end, number)),
            }
        }
    }

    pub(crate) fn oldest(&self) -> Revision {
        let numbers = self.runs.iter().map(|(_, number)| *number);
        Revision::new(Arc::clone(&self.uid), numbers.min().unwrap_or(0))
    }

    /// # Panics
    /// If there is no such row.
    pub(crate) fn of_row(&self, row: usize) -> Revision {
        let run = self.runs.partition_point(|(end, _)| *end <= row);
        Revision::new(Arc::clone(&self.uid), self.runs[run].1)
    }
}
