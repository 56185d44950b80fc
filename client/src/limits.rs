//! Divides requests among calls that keep the server's limits.
//!
//! How large an answer gets is not always known before. Where one is too large, the server refuses the call with
//! `RESOURCE_EXHAUSTED` and names the limit, and a read is divided further, down to single rows.

use std::ops::Range;

use tonic::Code;

use crate::{Client, Error, Limits};

/// The most states or ids that the client puts into one read, so that a call keeps within its timeout.
pub const READ_ROWS: usize = 1_000;

/// Divides the rows of a mutation, in order, so that each part has at most `max_rows` and its rows, `bytes` each, fit
/// into a request; a single row may exceed that. No rows make one empty part, which the server answers.
pub(crate) fn divide(
    limits: &Limits,
    rows: usize,
    max_rows: usize,
    bytes: impl Fn(usize) -> usize,
) -> Vec<Range<usize>> {
    /// The bytes reserved for the fields of a request other than its rows.
    const FRAME_BYTES: usize = 64 * 1024;
    let max_bytes = limits.request_bytes.saturating_sub(FRAME_BYTES);
    let mut parts = Vec::new();
    let (mut start, mut held) = (0, 0);
    for row in 0..rows {
        let needs = bytes(row);
        if row > start && (row - start >= max_rows || held + needs > max_bytes) {
            parts.push(start..row);
            (start, held) = (row, 0);
        }
        held += needs;
    }
    parts.push(start..rows);
    parts
}

/// Reads rows in calls of at most `max_rows`, one after the other, and halves that where the server or the transport
/// finds a call or its answer too large. The answers are appended to the first.
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

/// The limits of a server that a call of fewer rows keeps.
const LIMITS_BY_ROWS: [&str; 5] = [
    "answer_bytes",
    "grpc.max_message_bytes",
    "request_bytes",
    "rows_per_call",
    "ids_per_call",
];

fn is_too_large(error: &Error) -> bool {
    match error {
        // The transport's code for an answer above the client's own limit.
        Error::Refused(refusal) if refusal.code == Code::OutOfRange => true,
        Error::Refused(refusal) if refusal.code == Code::ResourceExhausted => {
            let limit = refusal.metadata.get("limit");
            limit.is_some_and(|limit| LIMITS_BY_ROWS.contains(&limit.as_str()))
        }
        _ => false,
    }
}

/// How many rows of `row_bytes` one answer holds, at least one.
pub(crate) fn rows_of_answer(client: &Client, limits: &Limits, row_bytes: usize) -> usize {
    /// The bytes reserved for the fields of an answer other than its rows.
    const FRAME_BYTES: usize = 1024;
    let bytes = client.max_message_bytes().min(limits.answer_bytes);
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

/// The operation ids of the parts of a call: the call's own for the first, and for each other one with its first row. If a
/// repeated call is divided in another way, an id comes with other rows, and the server refuses it.
pub(crate) fn operation_ids(id: &str, parts: &[Range<usize>]) -> Result<Vec<String>, Error> {
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
