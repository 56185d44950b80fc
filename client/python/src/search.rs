//! Searches, as Rust's `Search` builds them, and the factors of PRM* and RRT*.

use std::time::Duration;

use pyo3::{
    conversion::FromPyObjectOwned,
    exceptions::{PyOverflowError, PyTypeError},
    prelude::*,
};

use crate::error::invalid;

/// A search: the number of neighbours, the radius, and the points that count.
#[pyclass(frozen, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct Search {
    pub(crate) search: wayfold::Search,
}

#[pymethods]
impl Search {
    #[new]
    #[pyo3(signature = (k=None, *, k_factor=None, radius=None, tag=None, since=None, epsilon=0.0, timeout=None))]
    #[expect(clippy::too_many_arguments, reason = "each has a name in Python")]
    fn new(
        py: Python<'_>,
        k: Option<&Bound<'_, PyAny>>,
        k_factor: Option<f64>,
        radius: Option<Radius<'_>>,
        #[pyo3(from_py_with = tag_of)] tag: Option<(u64, u64)>,
        #[pyo3(from_py_with = since_of)] since: Option<u64>,
        epsilon: f64,
        timeout: Option<f64>,
    ) -> PyResult<Search> {
        let radius = radius.map(wayfold::Radius::from);
        let mut search = match (k, k_factor) {
            (Some(_), Some(_)) => return Err(invalid(py, "k, k_factor: a search has one of them")),
            (Some(k), None) => wayfold::Search::k(k_of(k)?),
            (None, Some(factor)) => wayfold::Search::k_factor(factor),
            (None, None) => match radius {
                Some(radius) => wayfold::Search::within(radius),
                None => return Err(invalid(py, "a search has k, k_factor or radius")),
            },
        };
        if let Some(radius) = radius {
            search = search.radius(radius);
        }
        if let Some((mask, value)) = tag {
            search = search.tag(mask, value);
        }
        if let Some(since) = since {
            search = search.since(wayfold::ReadRevision(since));
        }
        if let Some(timeout) = timeout {
            search = search.timeout(seconds(py, timeout)?);
        }
        let search = search.epsilon(epsilon);
        Ok(Search { search })
    }

    fn __repr__(&self) -> String {
        format!("{:?}", self.search)
    }
}

/// The radius of PRM* and RRT*: r(n) = min(max, factor · (ln n / n)^(1/d)).
#[pyclass(frozen, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct ScaledRadius {
    radius: wayfold::ScaledRadius,
}

#[pymethods]
impl ScaledRadius {
    #[new]
    #[pyo3(signature = (factor, *, max=None))]
    fn new(factor: f64, max: Option<f64>) -> ScaledRadius {
        let radius = wayfold::ScaledRadius::new(factor);
        ScaledRadius {
            radius: max.map_or(radius, |max| radius.max(max)),
        }
    }
}

/// A radius as an argument.
#[derive(FromPyObject)]
pub(crate) enum Radius<'py> {
    /// A number.
    Fixed(f64),
    /// A radius by the number of points.
    Scaled(Bound<'py, ScaledRadius>),
}

impl From<Radius<'_>> for wayfold::Radius {
    fn from(radius: Radius<'_>) -> wayfold::Radius {
        match radius {
            Radius::Fixed(radius) => radius.into(),
            Radius::Scaled(radius) => radius.get().radius.into(),
        }
    }
}

/// The factors of the number of neighbours and of the radius that the literature proves.
#[pyclass(frozen, module = "wayfold")]
#[derive(Debug)]
pub(crate) struct Scaling;

#[pymethods]
impl Scaling {
    /// 2e, the choice of Karaman and Frazzoli for all problems.
    #[classattr]
    const K_FACTOR: f64 = wayfold::Scaling::K_FACTOR;

    /// Above this factor k-nearest PRM* and RRG are asymptotically optimal.
    #[staticmethod]
    fn k_bound(#[pyo3(from_py_with = dimension_of)] dimension: usize) -> f64 {
        wayfold::Scaling::k_bound(dimension)
    }

    /// Above this factor PRM* and RRG are asymptotically optimal.
    #[staticmethod]
    fn prm_star_bound(
        #[pyo3(from_py_with = dimension_of)] dimension: usize,
        free_volume: f64,
    ) -> f64 {
        wayfold::Scaling::prm_star_bound(dimension, free_volume)
    }

    /// Above this factor RRT* is asymptotically optimal.
    #[staticmethod]
    fn rrt_star_bound(
        #[pyo3(from_py_with = dimension_of)] dimension: usize,
        free_volume: f64,
    ) -> f64 {
        wayfold::Scaling::rrt_star_bound(dimension, free_volume)
    }
}

/// A number of neighbours.
pub(crate) fn k_of(k: &Bound<'_, PyAny>) -> PyResult<u32> {
    let py = k.py();
    let number = saturated(k).map_err(|error| match error.is_instance_of::<PyTypeError>(py) {
        true => PyTypeError::new_err(format!("k: {}", error.value(py))),
        false => error,
    })?;
    match u32::try_from(number) {
        Ok(k) if k > 0 => Ok(k),
        _ if number > 0 => Err(invalid(
            k.py(),
            &format!("k: {k}; it is at most {}", u32::MAX),
        )),
        _ => Err(invalid(k.py(), &format!("k: {k}; it is at least 1"))),
    }
}

/// A whole number, or the nearest one of 64 bits.
pub(crate) fn saturated(number: &Bound<'_, PyAny>) -> PyResult<i64> {
    match number.extract::<i64>() {
        Err(error) if error.is_instance_of::<PyOverflowError>(number.py()) => {
            Ok(match number.lt(0)? {
                true => i64::MIN,
                false => i64::MAX,
            })
        }
        extracted => extracted,
    }
}

/// An id to insert a point with.
pub(crate) fn id_of(id: &Bound<'_, PyAny>) -> PyResult<Option<u64>> {
    unsigned("id", id)
}

/// A tag, or a mask and a value.
pub(crate) fn tag_of<'py, T: FromPyObjectOwned<'py>>(tag: &Bound<'py, PyAny>) -> PyResult<T> {
    unsigned("tag", tag)
}

/// The revision that an earlier answer read.
pub(crate) fn since_of<'py, T: FromPyObjectOwned<'py>>(since: &Bound<'py, PyAny>) -> PyResult<T> {
    unsigned("since", since)
}

fn dimension_of(dimension: &Bound<'_, PyAny>) -> PyResult<usize> {
    unsigned("dimension", dimension)
}

/// The whole numbers of an argument. The `OverflowError` of PyO3 would not name the field.
pub(crate) fn unsigned<'py, T: FromPyObjectOwned<'py>>(
    field: &str,
    argument: &Bound<'py, PyAny>,
) -> PyResult<T> {
    argument.extract::<T>().map_err(|error| {
        let (py, error): (_, PyErr) = (argument.py(), error.into());
        match error.is_instance_of::<PyOverflowError>(py) {
            true => {
                let range = "numbers are at least 0 and have at most 64 bits";
                invalid(py, &format!("{field}: {argument}; {range}"))
            }
            false => error,
        }
    })
}

/// A timeout in seconds.
pub(crate) fn seconds(py: Python<'_>, seconds: f64) -> PyResult<Duration> {
    match seconds {
        // Rust has no infinite duration.
        f64::INFINITY => Ok(Duration::MAX),
        seconds => Duration::try_from_secs_f64(seconds)
            .map_err(|error| invalid(py, &format!("timeout: {seconds}: {error}"))),
    }
}
