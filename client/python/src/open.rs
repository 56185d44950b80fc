//! The two forms of an index that have a server.

use pyo3::{exceptions::PyValueError, prelude::*};
use wayfold::{Credentials, PayloadEncoding};

use crate::{
    error::OrRaise,
    index::{Form, Index},
    search::{seconds, unsigned},
    space::of_argument,
};

/// The index of this name on a server, with a copy of it in this process.
#[pyfunction]
#[pyo3(signature = (url, name, *, create=None, payload_encoding=None, timeout=30.0, max_pending_bytes=16 << 20, token=None,
    ca_certificate=None, client_certificate=None))]
#[expect(clippy::too_many_arguments, reason = "each has a name in Python")]
pub(crate) fn shared(
    py: Python<'_>,
    url: &str,
    name: &str,
    create: Option<&Bound<'_, PyAny>>,
    payload_encoding: Option<&str>,
    timeout: f64,
    #[pyo3(from_py_with = max_pending_bytes_of)] max_pending_bytes: usize,
    token: Option<String>,
    ca_certificate: Option<Vec<u8>>,
    client_certificate: Option<(Vec<u8>, Vec<u8>)>,
) -> PyResult<Index> {
    let mut open = wayfold::Index::shared(url, name)
        .timeout(seconds(py, "timeout", timeout)?)
        .max_pending_bytes(max_pending_bytes)
        .credentials(credentials(token, ca_certificate, client_certificate));
    if let Some(space) = create {
        let declared = encoding(payload_encoding)?;
        open = open.create(&of_argument(space)?).payload_encoding(declared);
    }
    let index = py.detach(|| open.open()).or_raise(py)?;
    Index::of(py, index, Form::Shared)
}

/// The index of this name on a server, without a copy: each call goes to the server.
#[pyfunction]
#[pyo3(signature = (url, name, *, create=None, payload_encoding=None, timeout=30.0, token=None, ca_certificate=None,
    client_certificate=None))]
#[expect(clippy::too_many_arguments, reason = "each has a name in Python")]
pub(crate) fn remote(
    py: Python<'_>,
    url: &str,
    name: &str,
    create: Option<&Bound<'_, PyAny>>,
    payload_encoding: Option<&str>,
    timeout: f64,
    token: Option<String>,
    ca_certificate: Option<Vec<u8>>,
    client_certificate: Option<(Vec<u8>, Vec<u8>)>,
) -> PyResult<Index> {
    let mut open = wayfold::Index::remote(url, name)
        .timeout(seconds(py, "timeout", timeout)?)
        .credentials(credentials(token, ca_certificate, client_certificate));
    if let Some(space) = create {
        let declared = encoding(payload_encoding)?;
        open = open.create(&of_argument(space)?).payload_encoding(declared);
    }
    let index = py.detach(|| open.open()).or_raise(py)?;
    Index::of(py, index, Form::Remote)
}

fn max_pending_bytes_of(bytes: &Bound<'_, PyAny>) -> PyResult<usize> {
    unsigned("max_pending_bytes", bytes)
}

fn encoding(name: Option<&str>) -> PyResult<PayloadEncoding> {
    match name {
        None => Ok(PayloadEncoding::Unspecified),
        Some("edges") => Ok(PayloadEncoding::Edges),
        Some("weighted-edges") => Ok(PayloadEncoding::WeightedEdges),
        Some(other) => {
            let text =
                format!("payload_encoding: {other:?} is neither \"edges\" nor \"weighted-edges\"");
            Err(PyValueError::new_err(text))
        }
    }
}

fn credentials(
    token: Option<String>,
    ca: Option<Vec<u8>>,
    identity: Option<(Vec<u8>, Vec<u8>)>,
) -> Credentials {
    let mut credentials = Credentials::new();
    if let Some(token) = token {
        credentials = credentials.token(token);
    }
    if let Some(ca) = ca {
        credentials = credentials.ca_certificate(ca);
    }
    if let Some((certificate, key)) = identity {
        credentials = credentials.client_certificate(certificate, key);
    }
    credentials
}
