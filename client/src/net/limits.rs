//! Divides requests among calls that keep the server's limits.
//!
//! The size of an answer is not always known before the call. If an answer is too large, the server refuses the call
//! with `RESOURCE_EXHAUSTED` and names the limit, and the client divides a read further, down to single rows.

use std::ops::Range;

use tonic::Code;

use crate::{Client, Error, IndexHandle, Limits, net::call::Call};

/// The most states or ids that the client puts into one read, so that a call keeps within its timeout.
pub const READ_ROWS: usize = 1_000;

/// A mutation, divided by rows.
pub(crate) struct Division<'a> {
    index: &'a IndexHandle,
    rows: usize,
    ids: &'a [u64],
    operation_id: &'a str,
}

impl<'a> Division<'a> {
    /// A mutation of this many rows, with their ids or none.
    pub(crate) fn new(
        index: &'a IndexHandle,
        rows: usize,
        ids: &'a [u64],
        operation_id: &'a str,
    ) -> Self {
        Division {
            index,
            rows,
            ids,
            operation_id,
        }
    }

    /// Sends the mutation in parts, in order. If the server names a lower limit than the client knows, as after a
    /// restart with other settings, the client divides the rest again.
    pub(crate) async fn write<C: Call>(
        &self,
        max_rows: impl Fn(&Limits) -> usize,
        row_bytes: impl Fn(usize) -> usize,
        message: impl Fn(&Range<usize>, &str) -> C,
        mut append: impl FnMut(C::Answer, usize) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let (mut limits, mut deadline) = self.index.limits(C::NAME, self.rows).await?;
        let (mut rest, mut most) = (0..self.rows, usize::MAX);
        'divided: loop {
            let rows = max_rows(&limits).min(most);
            let parts = divide(&limits, rest.clone(), rows, &row_bytes);
            let failed = |error| partial(&rest, self.rows, error);
            if parts.len() > 1 {
                check_unique(self.ids).map_err(failed)?;
            }
            let operation_ids = operation_ids(self.operation_id, &parts).map_err(failed)?;
            for (part, operation_id) in parts.iter().zip(&operation_ids) {
                let message = || message(part, operation_id);
                match self.index.call(deadline.take(), message).await {
                    Ok(answer) => append(answer, part.len())?,
                    Err(error) => {
                        match limits.lowered(&error) {
                            Some(lowered) if part.len() > 1 => limits = lowered,
                            // The sizes of neighbours and of stored points are not known before.
                            _ if part.len() > 1
                                && matches!(
                                    exceeded(&error),
                                    Some(ANSWER_BYTES | CHANGED_POINT_BYTES)
                                ) =>
                            {
                                most = part.len().div_ceil(2);
                            }
                            // It has taken effect.
                            _ if is_unread(&error) => {
                                return Err(partial(&(part.end..self.rows), self.rows, error));
                            }
                            _ => return Err(partial(part, self.rows, error)),
                        }
                        rest.start = part.start;
                        continue 'divided;
                    }
                }
            }
            return Ok(());
        }
    }
}

/// Divides the rows of a mutation, in order, so that each part has at most `max_rows` and its rows, `bytes` each, fit
/// into a request; a single row may exceed that. No rows make one empty part, which the server answers.
fn divide(
    limits: &Limits,
    rows: Range<usize>,
    max_rows: usize,
    bytes: impl Fn(usize) -> usize,
) -> Vec<Range<usize>> {
    /// The bytes reserved for the fields of a request other than its rows.
    const FRAME_BYTES: usize = 64 * 1024;
    let max_bytes = limits.max_request_bytes.saturating_sub(FRAME_BYTES);
    let mut parts = Vec::new();
    let (end, mut start, mut held) = (rows.end, rows.start, 0);
    for row in rows {
        let needs = bytes(row);
        if row > start && (row - start >= max_rows || held + needs > max_bytes) {
            parts.push(start..row);
            (start, held) = (row, 0);
        }
        held += needs;
    }
    parts.push(start..end);
    parts
}

impl Limits {
    /// These limits with the one that `error` names, if that is lower.
    pub(crate) fn lowered(mut self, error: &Error) -> Option<Limits> {
        let Error::Refused(refusal) = error else {
            return None;
        };
        let limit = match refusal.metadata.get("limit")?.as_str() {
            "max_rows_per_call" => &mut self.max_rows_per_call,
            "max_ids_per_call" => &mut self.max_ids_per_call,
            ANSWER_BYTES => &mut self.max_answer_bytes,
            "grpc.max_message_bytes" => &mut self.max_request_bytes,
            _ => return None,
        };
        let named = refusal.metadata.get("value")?.parse().ok()?;
        if named >= *limit {
            return None;
        }
        *limit = named;
        Some(self)
    }
}

/// Reads rows of an index like [`read_in_parts`]. `max_rows` is the most that a call may read under the server's limits,
/// or a refusal of the whole read.
pub(crate) async fn read<C: Call, A>(
    index: &IndexHandle,
    rows: usize,
    max_rows: impl FnOnce(&Limits) -> Result<usize, Error>,
    message: impl Fn(Range<usize>) -> C,
    answer: impl Fn(C::Answer, Range<usize>) -> Result<A, Error>,
    append: fn(&mut A, A),
) -> Result<A, Error> {
    let (limits, mut deadline) = index.limits(C::NAME, rows).await?;
    let (message, answer) = (&message, &answer);
    let read = |part: Range<usize>| {
        let deadline = deadline.take();
        async move {
            let sent = index.call(deadline, || message(part.clone())).await?;
            answer(sent, part)
        }
    };
    read_in_parts(rows, max_rows(&limits)?, read, append).await
}

/// Reads rows in calls of at most `max_rows`, one after the other, and halves that if the server or the transport finds
/// a call or its answer too large. The answers are appended to the first.
pub(crate) async fn read_in_parts<A, F, Fut>(
    rows: usize,
    max_rows: usize,
    mut read: F,
    append: fn(&mut A, A),
) -> Result<A, Error>
where
    F: FnMut(Range<usize>) -> Fut,
    Fut: Future<Output = Result<A, Error>>,
{
    let (mut answers, mut start, mut step) = (None, 0, max_rows.max(1));
    loop {
        let end = rows.min(start + step);
        let answer = match read(start..end).await {
            Err(error) if end - start > 1 && is_too_large(&error) => {
                step = (end - start).div_ceil(2);
                continue;
            }
            answer => answer?,
        };
        let so_far = match answers.take() {
            None => answer,
            Some(mut before) => {
                append(&mut before, answer);
                before
            }
        };
        if end >= rows {
            return Ok(so_far);
        }
        (answers, start) = (Some(so_far), end);
    }
}

/// The limit of the bytes of an answer.
pub(crate) const ANSWER_BYTES: &str = "max_answer_bytes";

/// The limit of the bytes of the stored points that one call changes.
const CHANGED_POINT_BYTES: &str = "max_changed_point_bytes";

/// The limits of a server that a call with fewer rows can meet.
const LIMITS_BY_ROWS: [&str; 4] = [
    ANSWER_BYTES,
    "grpc.max_message_bytes",
    "max_rows_per_call",
    "max_ids_per_call",
];

fn is_too_large(error: &Error) -> bool {
    is_unread(error) || exceeded(error).is_some_and(|limit| LIMITS_BY_ROWS.contains(&limit))
}

/// True for the transport's refusal of an answer above the client's own limit.
fn is_unread(error: &Error) -> bool {
    matches!(error, Error::Refused(refusal) if refusal.code == Code::OutOfRange)
}

/// The limit that a refused call exceeds. The call changed nothing.
pub(crate) fn exceeded(error: &Error) -> Option<&str> {
    match error {
        Error::Refused(refusal) if refusal.code == Code::ResourceExhausted => {
            refusal.metadata.get("limit").map(String::as_str)
        }
        _ => None,
    }
}

/// The number of rows of `row_bytes` that one answer holds, at least one.
pub(crate) fn rows_of_answer(client: &Client, limits: &Limits, row_bytes: usize) -> usize {
    /// The bytes reserved for the fields of an answer other than its rows.
    const FRAME_BYTES: usize = 1024;
    let bytes = client.max_message_bytes().min(limits.max_answer_bytes);
    (bytes.saturating_sub(FRAME_BYTES) / row_bytes.max(1)).max(1)
}

/// Refuses an id that is given twice, which the server cannot see once the ids are divided among several calls.
pub(crate) fn check_unique(ids: &[u64]) -> Result<(), Error> {
    let mut sorted = ids.to_vec();
    sorted.sort_unstable();
    match sorted.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(Error::Argument {
            field: "ids",
            problem: format!("{} is given twice", pair[0]),
        }),
        None => Ok(()),
    }
}

/// The operation ids of the parts of a call: the call's own for the first, and for each other one with its first row.
/// If a repeated call is divided in another way, an id comes with other rows, and the server refuses it.
fn operation_ids(id: &str, parts: &[Range<usize>]) -> Result<Vec<String>, Error> {
    const MAX_BYTES: usize = 64;
    let of_part = |part: &Range<usize>| {
        let id = match part.start {
            0 => id.to_owned(),
            row => format!("{id}/{row}"),
        };
        if id.len() > MAX_BYTES {
            return Err(Error::Argument {
                field: "operation_id",
                problem: format!("{id:?} is longer than {MAX_BYTES} bytes"),
            });
        }
        Ok(id)
    };
    parts.iter().map(of_part).collect()
}

/// The error of a part of a mutation of `rows` rows; that of a later part counts the rows that took effect before it.
fn partial(part: &Range<usize>, rows: usize, error: Error) -> Error {
    match part.start {
        0 => error,
        done => Error::Partial {
            done,
            rows,
            ids: Vec::new(),
            source: Box::new(error),
        },
    }
}
