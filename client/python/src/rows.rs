//! States as rows of numbers, from arrays and everything that the package makes arrays of.

use numpy::{
    PyArray, PyArray1, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn, PyUntypedArrayMethods,
    ndarray::Dimension,
};
use pyo3::{prelude::*, sync::PyOnceLock, types::PyTuple};
use wayfold::{Error, Space};

use crate::error::{OrRaise, invalid};

/// The states of an argument of shape (..., m).
pub(crate) struct Rows {
    /// The rows, one after the other.
    pub(crate) numbers: Vec<f64>,
    /// The shape without its last axis: empty for one state.
    pub(crate) shape: Vec<usize>,
}

/// Copies the states of an argument, the first of which errors call `first`.
pub(crate) fn rows(
    first: usize,
    states: &Bound<'_, PyAny>,
    space: &Space,
    names: &Bound<'_, PyTuple>,
) -> PyResult<Rows> {
    let (py, width) = (states.py(), space.coordinates());
    // The common case is checked first: one state costs little more than its search.
    if let Ok(array) = states.cast_exact::<PyArray1<f64>>()
        && array.len() == width
        && is_aligned(array)
    {
        // A noted borrow would cost more than the copy, during which no other thread of Python has its turn.
        let numbers = array.to_vec();
        let numbers = numbers.unwrap_or_else(|_| {
            let each = (0..width).filter_map(|at| array.get_owned(at));
            each.collect()
        });
        return Ok(Rows {
            numbers,
            shape: Vec::new(),
        });
    }
    // Python looks at the mask of a derived array.
    let array = match states.cast_exact::<PyArrayDyn<f64>>() {
        Ok(array) if is_aligned(array) => array.clone(),
        _ => {
            static TO_ARRAY: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
            let to_array = TO_ARRAY.import(py, "wayfold._states", "to_array")?;
            to_array
                .call1((states, names))?
                .cast_into::<PyArrayDyn<f64>>()?
        }
    };
    let Some((&found, shape)) = array.shape().split_last() else {
        return Err(invalid(py, "states: a number; a state is a row of numbers"));
    };
    if found != width {
        let error = Error::Width {
            row: first,
            expected: width,
            found,
        };
        return Err(error).or_raise(py);
    }
    Ok(Rows {
        shape: shape.to_vec(),
        numbers: copy(&array.try_readonly()?),
    })
}

/// False for numbers that Rust cannot read where they lie, as in a field of a packed structure.
fn is_aligned<D: Dimension>(array: &Bound<'_, PyArray<f64, D>>) -> bool {
    let numbers_apart = |stride: &isize| stride % (size_of::<f64>() as isize) == 0;
    array.data().is_aligned() && array.strides().iter().all(numbers_apart)
}

/// Copies one state, which errors call `row`.
pub(crate) fn one_state(
    row: usize,
    state: &Bound<'_, PyAny>,
    space: &Space,
    names: &Bound<'_, PyTuple>,
) -> PyResult<Vec<f64>> {
    let rows = rows(row, state, space, names)?;
    match rows.shape.is_empty() {
        true => Ok(rows.numbers),
        false => {
            let mut shape = rows.shape;
            shape.push(space.coordinates());
            let problem = format!("an array of shape {shape:?}, where one state belongs");
            Err(invalid(state.py(), &problem))
        }
    }
}

/// The numbers in the order of their indices, whatever their order in memory.
fn copy(array: &PyReadonlyArrayDyn<'_, f64>) -> Vec<f64> {
    match array.as_slice() {
        // The crate also makes slices of arrays in Fortran's order.
        Ok(numbers) if array.is_c_contiguous() => numbers.to_vec(),
        _ => array.as_array().iter().copied().collect(),
    }
}
