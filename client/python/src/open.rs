//! The two forms of an index that have a server.

use pyo3::prelude::*;
use wayfold::{Credentials, PayloadEncoding};

use crate::{
    error::{OrRaise, invalid},
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
        .timeout(seconds(py, timeout)?)
        .max_pending_bytes(max_pending_bytes)
        .credentials(credentials(token, ca_certificate, client_certificate));
    if let Some((space, encoding)) = created(py, create, payload_encoding)? {
        open = open.create(&space).payload_encoding(encoding);
    }
    let index = py.detach(|| open.open()).or_raise(py)?;
    Index::of(py, index, Form::Shared)
}

/// The index of this name on a server, without a copy: each call goes to the server.
#[pyfunction]
#[pyo3(signature = (url, name, *, create=None, payload_encoding=None, timeout=30.0, latest=false, token=None,
    ca_certificate=None, client_certificate=None))]
#[expect(clippy::too_many_arguments, reason = "each has a name in Python")]
pub(crate) fn remote(
    py: Python<'_>,
    url: &str,
    name: &str,
    create: Option<&Bound<'_, PyAny>>,
    payload_encoding: Option<&str>,
    timeout: f64,
    latest: bool,
    token: Option<String>,
    ca_certificate: Option<Vec<u8>>,
    client_certificate: Option<(Vec<u8>, Vec<u8>)>,
) -> PyResult<Index> {
    let mut open = wayfold::Index::remote(url, name)
        .timeout(seconds(py, timeout)?)
        .credentials(credentials(token, ca_certificate, client_certificate));
    if let Some((space, encoding)) = created(py, create, payload_encoding)? {
        open = open.create(&space).payload_encoding(encoding);
    }
    if latest {
        open = open.latest();
    }
    let index = py.detach(|| open.open()).or_raise(py)?;
    Index::of(py, index, Form::Remote)
}

fn max_pending_bytes_of(bytes: &Bound<'_, PyAny>) -> PyResult<usize> {
    unsigned("max_pending_bytes", bytes)
}

/// The space to create an index of, and the encoding of its payloads.
fn created(
    py: Python<'_>,
    create: Option<&Bound<'_, PyAny>>,
    payload_encoding: Option<&str>,
) -> PyResult<Option<(wayfold::Space, PayloadEncoding)>> {
    let problem = |problem: &str| Err(invalid(py, &format!("payload_encoding: {problem}")));
    let encoding = match payload_encoding {
        None => PayloadEncoding::Unspecified,
        Some("edges") => PayloadEncoding::Edges,
        Some("weighted-edges") => PayloadEncoding::WeightedEdges,
        Some(other) => {
            return problem(&format!(
                "{other:?} is neither \"edges\" nor \"weighted-edges\""
            ));
        }
    };
    match create {
        Some(space) => Ok(Some((of_argument(space)?, encoding))),
        None if payload_encoding.is_some() => problem("only an index to create declares one"),
        None => Ok(None),
    }
}

/// The name of an encoding in Python; none for one that is not declared.
pub(crate) fn name_of(encoding: PayloadEncoding) -> Option<&'static str> {
    match encoding {
        PayloadEncoding::Unspecified => None,
        PayloadEncoding::Edges => Some("edges"),
        PayloadEncoding::WeightedEdges => Some("weighted-edges"),
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
