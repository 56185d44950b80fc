//! Reads a request from JSON.

use base64::{Engine, prelude::BASE64_STANDARD};
use prost_reflect::{
    DynamicMessage, EnumDescriptor, FieldDescriptor, Kind, MessageDescriptor, ReflectMessage, Value,
};
use serde_json::Value as Json;

use super::{
    invalid, malformed,
    path::Path,
    schema::{self, special},
};
use crate::service::Error;

/// Reads a message, and the names of the fields that are present. An array stands for the states of a request that has
/// states.
pub(super) fn message(
    descriptor: MessageDescriptor,
    text: &[u8],
) -> Result<(DynamicMessage, Vec<String>), Error> {
    let json: Json = serde_json::from_slice(text).map_err(malformed)?;
    let mut message = DynamicMessage::new(descriptor.clone());
    let mut named = Vec::new();
    match (json, descriptor.get_field_by_name("states")) {
        (Json::Object(fields), _) => {
            fill(&mut message, &fields, None)?;
            names(&fields, "", &mut named);
        }
        (json @ Json::Array(_), Some(field)) => {
            let states = value(&field.kind(), &json, &Path::of("states"))?;
            message.set_field(&field, states);
        }
        (json, _) => return Err(wrong(&Path::of("request"), "an object", &json)),
    }
    Ok((message, named))
}

type Fields = serde_json::Map<String, Json>;

/// Adds the names of the fields that are present, with the path of nested ones: `after_revision.number`.
fn names(fields: &Fields, before: &str, named: &mut Vec<String>) {
    for (name, json) in fields.iter().filter(|(_, json)| !json.is_null()) {
        let name = format!("{before}{name}");
        if let Json::Object(fields) = json {
            names(fields, &format!("{name}."), named);
        }
        named.push(name);
    }
}

/// Sets the fields of the message at `path`; None is the request itself.
fn fill(
    message: &mut DynamicMessage,
    fields: &Fields,
    path: Option<&Path<'_>>,
) -> Result<(), Error> {
    let descriptor = message.descriptor();
    for (name, json) in fields {
        let field_path = path.map_or_else(|| Path::of(name), |path| path.field(name));
        let Some(field) = descriptor.get_field_by_name(name) else {
            return Err(unknown_field(&field_path, &descriptor));
        };
        if json.is_null() {
            continue;
        }
        if let Some(other) = rival(message, &field) {
            return Err(ambiguous(&field_path, &other));
        }
        let read = if field.is_list() {
            list(&field, json, &field_path)?
        } else {
            value(&field.kind(), json, &field_path)?
        };
        message.set_field(&field, read);
    }
    Ok(())
}

/// The field that is already set in the oneof of `field`.
pub(super) fn rival(message: &DynamicMessage, field: &FieldDescriptor) -> Option<FieldDescriptor> {
    let one = field.containing_oneof().filter(|one| !one.is_synthetic())?;
    let is_rival = |other: &FieldDescriptor| other != field && message.has_field(other);
    one.fields().find(is_rival)
}

/// The refusal of a second field of a oneof.
pub(super) fn ambiguous(path: &Path<'_>, rival: &FieldDescriptor) -> Error {
    let text = format!(
        "{} is set too; set only one of {path} and {}",
        rival.name(),
        rival.name()
    );
    invalid(path.to_string(), "AMBIGUOUS", text)
}

fn list(field: &FieldDescriptor, json: &Json, path: &Path<'_>) -> Result<Value, Error> {
    let Json::Array(elements) = json else {
        return Err(wrong(path, "an array", json));
    };
    let kind = field.kind();
    let read = elements.iter().enumerate();
    let read = read.map(|(at, element)| value(&kind, element, &path.at(at)));
    read.collect::<Result<_, _>>().map(Value::List)
}

fn value(kind: &Kind, json: &Json, path: &Path<'_>) -> Result<Value, Error> {
    Ok(match (kind, json) {
        (Kind::Double, _) => Value::F64(number(json, path)?),
        (Kind::Uint32 | Kind::Fixed32, _) => {
            let read = unsigned(json).and_then(|number| u32::try_from(number).ok());
            Value::U32(read.ok_or_else(|| wrong(path, "an integer from 0 to 2^32 - 1", json))?)
        }
        (Kind::Uint64 | Kind::Fixed64, _) => {
            let read = unsigned(json);
            Value::U64(read.ok_or_else(|| wrong(path, "an integer from 0 to 2^64 - 1", json))?)
        }
        (Kind::Bool, Json::Bool(read)) => Value::Bool(*read),
        (Kind::Bool, _) => return Err(wrong(path, "true or false", json)),
        (Kind::String, Json::String(read)) => Value::String(read.clone()),
        (Kind::String, _) => return Err(wrong(path, "a string", json)),
        (Kind::Bytes, Json::String(text)) => match BASE64_STANDARD.decode(text) {
            Ok(read) => Value::Bytes(read.into()),
            Err(problem) => {
                let text = format!("not Base64: {problem}");
                return Err(invalid(path.to_string(), "TYPE", text));
            }
        },
        (Kind::Bytes, _) => return Err(wrong(path, "a string in Base64", json)),
        (Kind::Enum(names), Json::String(name)) => Value::EnumNumber(named(names, name, path)?),
        (Kind::Enum(_), Json::Number(number)) => {
            let read = number
                .as_i64()
                .and_then(|number| i32::try_from(number).ok());
            Value::EnumNumber(read.ok_or_else(|| wrong(path, "a name or its number", json))?)
        }
        (Kind::Enum(_), _) => return Err(wrong(path, "a name", json)),
        (Kind::Message(descriptor), Json::Object(fields)) => {
            let mut message = DynamicMessage::new(descriptor.clone());
            fill(&mut message, fields, Some(path))?;
            Value::Message(message)
        }
        (Kind::Message(descriptor), Json::Array(rows))
            if descriptor.full_name() == special::STATES =>
        {
            Value::Message(states(descriptor, rows, path)?)
        }
        (Kind::Message(_), _) => return Err(wrong(path, "an object", json)),
        _ => {
            return Err(Error::Internal {
                what: format!("{path} is of a kind that no request has"),
            });
        }
    })
}

/// Rows, or one row.
fn states(
    descriptor: &MessageDescriptor,
    rows: &[Json],
    path: &Path<'_>,
) -> Result<DynamicMessage, Error> {
    let is_one_row = rows.first().is_some_and(|first| !first.is_array());
    let mut coordinates = Vec::new();
    let count = if is_one_row {
        row(rows, &path.at(0), &mut coordinates)?;
        1
    } else {
        for (at, json) in rows.iter().enumerate() {
            let row_path = path.at(at);
            let Json::Array(numbers) = json else {
                return Err(wrong(&row_path, "a row: an array of numbers", json));
            };
            // The space checks a width that all rows share.
            let before = coordinates.len();
            if before != at * numbers.len() {
                let text = format!(
                    "{} numbers, where the rows before it have {}",
                    numbers.len(),
                    before / at
                );
                return Err(invalid(row_path.to_string(), "WIDTH", text));
            }
            row(numbers, &row_path, &mut coordinates)?;
        }
        rows.len()
    };
    let count = u32::try_from(count)
        .map_err(|_| invalid(path.to_string(), "WIDTH", format!("{count} rows")))?;
    let mut states = DynamicMessage::new(descriptor.clone());
    states.set_field_by_name("row_count", Value::U32(count));
    states.set_field_by_name("coordinates", Value::List(coordinates));
    Ok(states)
}

fn row(numbers: &[Json], path: &Path<'_>, coordinates: &mut Vec<Value>) -> Result<(), Error> {
    let coords = path.field("coords");
    for (at, json) in numbers.iter().enumerate() {
        coordinates.push(Value::F64(number(json, &coords.at(at))?));
    }
    Ok(())
}

fn number(json: &Json, path: &Path<'_>) -> Result<f64, Error> {
    let read = match json {
        Json::Number(number) => number.as_f64(),
        Json::String(name) => match &**name {
            "NaN" => Some(f64::NAN),
            "Infinity" => Some(f64::INFINITY),
            "-Infinity" => Some(f64::NEG_INFINITY),
            _ => None,
        },
        _ => None,
    };
    read.ok_or_else(|| wrong(path, "a number", json))
}

fn unsigned(json: &Json) -> Option<u64> {
    match json {
        Json::Number(number) => number.as_u64(),
        Json::String(digits) => digits.parse().ok(),
        _ => None,
    }
}

/// The number of an enumeration's value, by its name with or without the prefix.
pub(super) fn named(names: &EnumDescriptor, name: &str, path: &Path<'_>) -> Result<i32, Error> {
    let prefix = schema::prefix(names);
    let found = names
        .get_value_by_name(name)
        .or_else(|| names.get_value_by_name(&format!("{prefix}{name}")));
    found.map(|value| value.number()).ok_or_else(|| {
        let known = names.values().map(|value| {
            let name = value.name();
            name.strip_prefix(&prefix).unwrap_or(name).to_owned()
        });
        let known = known.collect::<Vec<_>>().join(", ");
        let text = format!("{name:?} is none of {known}");
        invalid(path.to_string(), "UNKNOWN_VALUE", text)
    })
}

fn unknown_field(path: &Path<'_>, descriptor: &MessageDescriptor) -> Error {
    let known: Vec<String> = descriptor
        .fields()
        .map(|field| field.name().into())
        .collect();
    let text = format!(
        "{} has no such field; it has {}",
        descriptor.name(),
        known.join(", ")
    );
    invalid(path.to_string(), "UNKNOWN_FIELD", text)
}

fn wrong(path: &Path<'_>, expected: &str, found: &Json) -> Error {
    let found = match found {
        Json::Null => "null".to_owned(),
        Json::Bool(_) => "a truth value".to_owned(),
        Json::Number(number) => number.to_string(),
        Json::String(text) => format!("{text:?}"),
        Json::Array(_) => "an array".to_owned(),
        Json::Object(_) => "an object".to_owned(),
    };
    invalid(
        path.to_string(),
        "TYPE",
        format!("{found} is not {expected}"),
    )
}
