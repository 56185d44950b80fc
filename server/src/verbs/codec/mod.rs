//! Encodes messages in Protocol Buffers, or in JSON for people.
//!
//! JSON has the fields of the messages under their own names, in plain numbers, with these differences. States are
//! rows, `[[0.1, 0.2], [0.3, 0.4]]`, or one row, `[0.1, 0.2]`. The neighbours of each state are a row (`"ids": [[3, 7],
//! [1]]`), without counts. Enumeration values have no prefix (`"REPLACE"`). Payloads are Base64. Integers from 2^53 up,
//! which JavaScript and others round, are written as strings; both forms are read. Numbers that JSON lacks are the
//! strings "NaN", "Infinity" and "-Infinity".

pub(super) mod parameters;
mod path;
mod read;
mod schema;
pub(super) mod write;

use prost::Name;
use prost_reflect::DynamicMessage;

use crate::service::{Error, Violation};

/// The most bytes of a request in JSON or beside parameters. The server reads such a request field by field, in about 80
/// times its bytes.
pub(crate) const MAX_DYNAMIC_BYTES: usize = 1024 * 1024;

/// The encoding of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Form {
    /// Protocol Buffers.
    Protobuf,
    /// JSON.
    Json,
}

impl Form {
    /// Decodes a request, and adds the selector's parameters.
    pub(crate) fn read<M: Name + Default>(
        self,
        payload: &[u8],
        parameters: &[(&str, &str)],
    ) -> Result<M, Error> {
        if self == Form::Protobuf && parameters.is_empty() {
            return M::decode(payload).map_err(malformed);
        }
        let descriptor = schema::message::<M>()?;
        let (mut message, named) = match self {
            Form::Protobuf => {
                let message = DynamicMessage::decode(descriptor, payload);
                // A field with its default value is not visible on the wire.
                (message.map_err(malformed)?, Vec::new())
            }
            Form::Json if payload.is_empty() => (DynamicMessage::new(descriptor), Vec::new()),
            Form::Json => read::message(descriptor, payload)?,
        };
        parameters::apply(&mut message, &named, parameters)?;
        message.transcode_to().map_err(|error| Error::Internal {
            what: format!("a {} that was read does not encode: {error}", M::NAME),
        })
    }

    /// Encodes a message.
    pub(crate) fn write<M: Name>(self, message: &M) -> Result<Vec<u8>, Error> {
        let encoded = message.encode_to_vec();
        match self {
            Form::Protobuf => Ok(encoded),
            Form::Json => {
                let message = DynamicMessage::decode(schema::message::<M>()?, &*encoded);
                let message = message.map_err(|error| Error::Internal {
                    what: format!("a {} does not decode: {error}", M::NAME),
                })?;
                Ok(write::json(&message).into_bytes())
            }
        }
    }
}

fn malformed(problem: impl std::fmt::Display) -> Error {
    invalid(
        "request",
        "MALFORMED_MESSAGE",
        format!("the message cannot be read: {problem}"),
    )
}

/// The refusal of a query with one wrong part.
pub(crate) fn invalid(
    field: impl Into<String>,
    reason: &'static str,
    description: impl Into<String>,
) -> Error {
    Error::InvalidArgument {
        violations: vec![Violation {
            field: field.into(),
            reason,
            description: description.into(),
        }],
    }
}

#[cfg(test)]
mod tests;
