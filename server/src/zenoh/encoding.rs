//! The forms of messages, as Zenoh names them.

use zenoh::bytes::Encoding;

use crate::{
    service::Error,
    verbs::{Form, invalid},
};

/// The form that an encoding names; an unnamed one is JSON.
pub(super) fn form(encoding: Option<&Encoding>) -> Result<Form, Error> {
    let Some(encoding) = encoding else {
        return Ok(Form::Json);
    };
    if *encoding == Encoding::APPLICATION_PROTOBUF {
        return Ok(Form::Protobuf);
    }
    let text = encoding.to_string();
    // A schema may follow the name.
    let name = text.split(';').next().unwrap_or_default();
    match name {
        "application/protobuf" => Ok(Form::Protobuf),
        "application/json" | "text/json" | "text/plain" | "zenoh/string" | "zenoh/bytes" => {
            Ok(Form::Json)
        }
        _ => Err(invalid(
            "encoding",
            "UNKNOWN_ENCODING",
            format!("{text:?} is neither application/protobuf nor application/json"),
        )),
    }
}

/// The encoding that names a form.
pub(super) fn encoding(form: Form) -> Encoding {
    match form {
        Form::Protobuf => Encoding::APPLICATION_PROTOBUF,
        Form::Json => Encoding::APPLICATION_JSON,
    }
}
