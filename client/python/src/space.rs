//! A configuration space.

use numpy::PyArray1;
use pyo3::{prelude::*, types::PyTuple};

use crate::{
    error::{OrRaise, invalid},
    rows::one_state,
};

/// A configuration space with its metric, made of its text, such as `R3*SO3:0.15`.
#[pyclass(frozen, eq, hash, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct Space {
    pub(crate) space: wayfold::Space,
    text: String,
}

impl PartialEq for Space {
    fn eq(&self, other: &Space) -> bool {
        self.space == other.space
    }
}

impl std::hash::Hash for Space {
    fn hash<H: std::hash::Hasher>(&self, state: &mut H) {
        // Equal spaces have the same text.
        self.text.hash(state);
    }
}

impl Space {
    pub(crate) fn of(space: wayfold::Space) -> Space {
        let text = space.to_string();
        Space { space, text }
    }

    /// The canonical form of the state that errors call `row`.
    fn canonical(&self, row: usize, state: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
        let py = state.py();
        let names = names(py, &self.space)?;
        let mut numbers = one_state(row, state, &self.space, names.bind(py))?;
        let canonical = self.space.canonicalize(&mut numbers);
        canonical
            .map_err(|error| wayfold::Error::State { row, error })
            .or_raise(py)?;
        Ok(numbers)
    }
}

#[pymethods]
impl Space {
    #[new]
    fn new(py: Python<'_>, text: &str) -> PyResult<Space> {
        Ok(Space::of(parse(py, text)?))
    }

    /// The text of the space.
    #[getter]
    fn text(&self) -> &str {
        &self.text
    }

    /// The number of coordinates of a state.
    #[getter]
    fn coordinates(&self) -> usize {
        self.space.coordinates()
    }

    /// The dimension of the space as a manifold: 6 for SE(3), whose states have 7 coordinates.
    #[getter]
    fn dimension(&self) -> usize {
        self.space.dimension()
    }

    /// A name for each coordinate.
    #[getter]
    fn names(&self, py: Python<'_>) -> PyResult<Py<PyTuple>> {
        names(py, &self.space)
    }

    /// The distance of two states.
    fn distance(&self, a: &Bound<'_, PyAny>, b: &Bound<'_, PyAny>) -> PyResult<f64> {
        Ok(self
            .space
            .distance(&self.canonical(0, a)?, &self.canonical(1, b)?))
    }

    /// The state in canonical form.
    fn canonicalize<'py>(&self, state: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let row = self.canonical(0, state)?;
        Ok(PyArray1::from_vec(state.py(), row))
    }

    fn __str__(&self) -> &str {
        &self.text
    }

    fn __repr__(&self) -> String {
        format!("Space('{}')", self.text)
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> (Bound<'py, PyAny>, (String,)) {
        (slf.get_type().into_any(), (slf.get().text.clone(),))
    }
}

/// The space of an argument: a `Space` or its text.
pub(crate) fn of_argument(argument: &Bound<'_, PyAny>) -> PyResult<wayfold::Space> {
    match argument.cast::<Space>() {
        Ok(space) => Ok(space.get().space.clone()),
        Err(_) => parse(argument.py(), argument.extract()?),
    }
}

/// A name for each coordinate of a state.
pub(crate) fn names(py: Python<'_>, space: &wayfold::Space) -> PyResult<Py<PyTuple>> {
    Ok(PyTuple::new(py, wayfold::coordinate_names(space))?.unbind())
}

fn parse(py: Python<'_>, text: &str) -> PyResult<wayfold::Space> {
    text.parse()
        .map_err(|error| invalid(py, &format!("space: {error}")))
}
