//! The places of own points in the order of a shared index.

use std::{ptr, time::Duration};

use client::MeanwhileAnswers;

use super::{
    connection::unforked_index_of,
    index::WayfoldIndex,
    pointers::{copy, put},
};
use crate::{code::Code, failure::call};

/// An own point's place in the order of a shared index, and the neighbours before it that its insert could not see, or left
/// out because its scaled `k` was smaller then. The columns are valid until the answers are freed.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct WayfoldAnswer {
    /// The id of the own point.
    pub id: u64,
    /// The number of points that the index had just before it; if `is_superset`, maybe at a later moment.
    pub points_before: usize,
    /// True if some of the neighbours may be known from the insert, or come after the point.
    pub is_superset: bool,
    /// The number of neighbours.
    pub count: usize,
    /// The ids of the neighbours, nearest first.
    pub ids: *const u64,
    /// Their distances.
    pub distances: *const f64,
}

/// Answers to inserts that were made with a search.
pub struct WayfoldAnswers {
    answers: Vec<WayfoldAnswer>,
    open: usize,
    has_dropped: bool,
    /// The columns of the answers.
    _columns: Vec<(Vec<u64>, Vec<f64>)>,
}

/// Reads the answers about own points that were inserted with a search, each once, as soon as the server has stored them:
/// the neighbours that others stored before, and that the insert could not see. Waits for one, at most for `timeout_ms`,
/// if there is none and one is to come. In the other forms an insert sees all, and there are no answers.
///
/// Thread-safe.
///
/// # Safety
/// `index` is a handle; `answers` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_index_meanwhile(
    index: *const WayfoldIndex,
    timeout_ms: u64,
    answers: *mut *mut WayfoldAnswers,
) -> Code {
    call(|| {
        // SAFETY: the caller's promise. Null at first: a pointer that cannot be written leaks no answers.
        unsafe { put(ptr::null_mut(), answers, "answers") }?;
        // SAFETY: the caller's promise.
        let index = unsafe { unforked_index_of(index) }?;
        let taken = match timeout_ms {
            0 => index.meanwhile(),
            timeout => index.wait_meanwhile(Duration::from_millis(timeout)),
        };
        let all = Box::into_raw(Box::new(WayfoldAnswers::of(taken)));
        // SAFETY: the caller's promise.
        unsafe { put(all, answers, "answers") }
    })
}

/// The number of answers. Thread-safe.
///
/// # Safety
/// `answers` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_answers_count(answers: *const WayfoldAnswers) -> usize {
    // SAFETY: the caller's promise.
    unsafe { answers.as_ref() }.map_or(0, |answers| answers.answers.len())
}

/// Writes one answer; false if there is none at this position. Thread-safe.
///
/// # Safety
/// `answers` is a handle; `answer` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_answers_get(
    answers: *const WayfoldAnswers,
    at: usize,
    answer: *mut WayfoldAnswer,
) -> bool {
    // SAFETY: the caller's promise.
    let one = unsafe { answers.as_ref() }.and_then(|answers| answers.answers.get(at));
    if let Some(one) = one {
        // SAFETY: the caller's promise.
        unsafe { copy(&[*one], answer) };
    }
    one.is_some()
}

/// The number of inserts with a search whose answers are still to come. Thread-safe.
///
/// # Safety
/// `answers` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_answers_open(answers: *const WayfoldAnswers) -> usize {
    // SAFETY: the caller's promise.
    unsafe { answers.as_ref() }.map_or(0, |answers| answers.open)
}

/// True if answers were dropped, because none were read for long. Thread-safe.
///
/// # Safety
/// `answers` is a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_answers_have_dropped(answers: *const WayfoldAnswers) -> bool {
    // SAFETY: the caller's promise.
    unsafe { answers.as_ref() }.is_some_and(|answers| answers.has_dropped)
}

/// Frees answers; null is ignored. No other thread may use them during this call or after it.
///
/// # Safety
/// `answers` is a handle that is not freed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn wayfold_answers_free(answers: *mut WayfoldAnswers) {
    if !answers.is_null() {
        // SAFETY: made of a box, and the caller promises that it is not freed.
        drop(unsafe { Box::from_raw(answers) });
    }
}

impl WayfoldAnswers {
    fn of(taken: MeanwhileAnswers) -> WayfoldAnswers {
        let columns: Vec<(Vec<u64>, Vec<f64>)> = taken
            .answers
            .iter()
            .map(|answer| {
                let near = answer.neighbors.iter();
                near.map(|near| (near.id, near.distance)).unzip()
            })
            .collect();
        let answers = taken.answers.iter().zip(&columns);
        let answers = answers.map(|(answer, (ids, distances))| WayfoldAnswer {
            id: answer.id,
            points_before: answer.points_before,
            is_superset: answer.is_superset,
            count: ids.len(),
            ids: ids.as_ptr(),
            distances: distances.as_ptr(),
        });
        WayfoldAnswers {
            answers: answers.collect(),
            open: taken.open,
            has_dropped: taken.has_dropped,
            _columns: columns,
        }
    }
}
