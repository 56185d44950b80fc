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
mod write;

use prost::Message;
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
    /// Decodes a request, `type_name` of `wayfold.v1`, and adds the selector's parameters.
    pub(crate) fn read<M: Message + Default>(
        self,
        type_name: &str,
        payload: &[u8],
        parameters: &[(&str, &str)],
    ) -> Result<M, Error> {
        if self == Form::Protobuf && parameters.is_empty() {
            return M::decode(payload).map_err(malformed);
        }
        let descriptor = schema::message(type_name)?;
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
            what: format!("a {type_name} that was read does not encode: {error}"),
        })
    }

    /// Encodes a message, `type_name` of `wayfold.v1`.
    pub(crate) fn write(self, type_name: &str, message: &impl Message) -> Result<Vec<u8>, Error> {
        let encoded = message.encode_to_vec();
        match self {
            Form::Protobuf => Ok(encoded),
            Form::Json => {
                let message = DynamicMessage::decode(schema::message(type_name)?, &*encoded);
                let message = message.map_err(|error| Error::Internal {
                    what: format!("a {type_name} does not decode: {error}"),
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
