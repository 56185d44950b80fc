//! How what is too much for one call is divided among several.
//!
//! The bounds below lie within the default limits of a server. A server with lower limits refuses a call with
//! `RESOURCE_EXHAUSTED`, naming the limit: reads are then divided further, down to single rows; a mutation fails.

use std::ops::Range;

use tonic::Code;

use crate::Error;

/// The most bytes of rows that the client puts into one request. Stock gRPC servers take messages of 4 MiB; what is
/// kept back is for the other fields.
pub const REQUEST_BYTES: usize = 4 * 1024 * 1024 - 64 * 1024;

/// The most rows that the client puts into one mutation; up to here it is one call, and atomic.
pub const MUTATION_ROWS: usize = 10_000;

/// The most states or ids that the client puts into one read, so that a call keeps within its timeout.
pub const READ_ROWS: usize = 1_000;

/// Divides rows, in order, so that each part has at most `most_rows` and its rows, `bytes` each, at most `most_bytes`;
/// a single row may exceed that. No rows make one empty part: what to say of it is the server's to decide.
pub(crate) fn divide(
    rows: usize,
    most_rows: usize,
    most_bytes: usize,
    bytes: impl Fn(usize) -> usize,
) -> Vec<Range<usize>> {
    let mut parts = Vec::new();
    let (mut start, mut held) = (0, 0);
    for row in 0..rows {
        let needs = bytes(row);
        if row > start && (row - start >= most_rows || held + needs > most_bytes) {
            parts.push(start..row);
            (start, held) = (row, 0);
        }
        held += needs;
    }
    parts.push(start..rows);
    parts
}

/// Reads rows in calls of at most `most_rows`, one after the other, and halves that where the server or the transport
/// finds a call or its answer too large. The answers are appended to the first.
pub(crate) async fn read_in_parts<A, F, Fut>(
    rows: usize,
    most_rows: usize,
    mut read: F,
    append: fn(&mut A, A),
) -> Result<A, Error>
where
    F: FnMut(Range<usize>) -> Fut,
    Fut: Future<Output = Result<A, Error>>,
{
    let (mut answers, mut start, mut step) = (None, 0, most_rows.max(1));
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

/// The limits of a server that a smaller call keeps.
const KEPT_BY_FEWER_ROWS: [&str; 4] = [
    "answer_bytes",
    "grpc.max_message_bytes",
    "rows_per_call",
    "ids_per_call",
];

fn is_too_large(error: &Error) -> bool {
    match error {
        // What the transport calls an answer above the client's own limit.
        Error::Refused(refusal) if refusal.code == Code::OutOfRange => true,
        Error::Refused(refusal) if refusal.code == Code::ResourceExhausted => {
            let limit = refusal.metadata.get("limit");
            limit.is_some_and(|limit| KEPT_BY_FEWER_ROWS.contains(&limit.as_str()))
        }
        _ => false,
    }
}

/// How many rows one answer holds if each takes `row_bytes`, at least one and at most `most_rows`.
pub(crate) fn rows_of_answer(answer_bytes: usize, row_bytes: usize, most_rows: usize) -> usize {
    /// What an answer holds beside its rows.
    const FRAME_BYTES: usize = 1024;
    let bytes = answer_bytes.saturating_sub(FRAME_BYTES);
    (bytes / row_bytes.max(1)).clamp(1, most_rows)
}

/// Says whether an id is given twice, which no single call could tell once the ids are divided among several.
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

/// The operation id of part `part` of `parts`: the call's own if there is one part only.
pub(crate) fn operation_id(id: &str, part: usize, parts: usize) -> Result<String, Error> {
    const MOST_BYTES: usize = 64;
    let id = if parts == 1 {
        id.to_owned()
    } else {
        format!("{id}/{part}")
    };
    if id.len() > MOST_BYTES {
        return Err(Error::Argument {
            field: "operation_id",
            problem: format!("{id:?} is longer than {MOST_BYTES} bytes"),
        });
    }
    Ok(id)
}
