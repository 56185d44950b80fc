//! The time that Rust takes for the searches of the benchmark.

use std::{hint::black_box, time::Instant};

use pyo3::prelude::*;

use crate::index::Index;

/// The seconds that Rust takes for the `k` nearest of all states: in one call, or one after the other. The benchmark
/// compares `query` with it.
#[pyfunction(name = "_seconds_in_rust")]
pub(crate) fn seconds_in_rust(
    index: &Bound<'_, Index>,
    states: &Bound<'_, PyAny>,
    k: u32,
    is_one_call: bool,
) -> PyResult<f64> {
    let (py, index) = (states.py(), index.get());
    let numbers = index.rows(states)?.numbers;
    let search = wayfold::Search::k(k);
    index.call(py, |index| {
        let width = index.space().coordinates();
        let began = Instant::now();
        if is_one_call {
            black_box(index.search_many(numbers.chunks_exact(width), &search)?);
        } else {
            for row in numbers.chunks_exact(width) {
                black_box(index.search(row, &search)?);
            }
        }
        Ok(began.elapsed().as_secs_f64())
    })
}
