//! What the parameters of a selector say of a request: `?k=10;r=0.5;eps=0`.

use prost_reflect::{DynamicMessage, FieldDescriptor, Kind, ReflectMessage, Value};

use super::{invalid, path::Path, read::named};
use crate::service::Error;

/// Short names of fields.
const SHORT: [(&str, &str); 4] = [
    ("r", "radius"),
    ("eps", "epsilon"),
    ("from", "after_revision"),
    ("space", "space_text"),
];

/// Sets the fields that parameters name. What the message says already, they may repeat, but not change: the fields that
/// it has, and those of which it says by name that they are what they would be anyway.
pub(super) fn apply(
    message: &mut DynamicMessage,
    named: &[String],
    parameters: &[(&str, &str)],
) -> Result<(), Error> {
    let mut set = Vec::new();
    for (name, text) in parameters {
        let full = SHORT.iter().find(|(short, _)| short == name);
        let full = full.map_or(*name, |(_, full)| full);
        let field = message.descriptor().get_field_by_name(full);
        let field = field
            .filter(can_be_set)
            .ok_or_else(|| unknown(message, name))?;
        let value = read(&field, text)?;
        let is_said = message.has_field(&field)
            || named.iter().any(|named| named == full)
            || set.contains(&full);
        if is_said && *message.get_field(&field) != value {
            let text = format!("the parameter {name}={text} and the rest of the query disagree");
            return Err(invalid(full, "CONFLICT", text));
        }
        message.set_field(&field, value);
        set.push(full);
    }
    Ok(())
}

/// Whether a value can be written in a few letters. The name of the index is in the key.
fn can_be_set(field: &FieldDescriptor) -> bool {
    let is_short = !matches!(field.kind(), Kind::Message(_) | Kind::Bytes);
    is_short && field.name() != "index"
}

fn unknown(message: &DynamicMessage, name: &str) -> Error {
    let fields = message.descriptor();
    let known = fields.fields().filter(can_be_set).map(|field| {
        let short = SHORT.iter().find(|(_, full)| *full == field.name());
        short.map_or_else(
            || field.name().to_owned(),
            |(short, full)| format!("{short} ({full})"),
        )
    });
    let known: Vec<String> = known.chain(["timeout_ms".to_owned()]).collect();
    let text = format!(
        "there is no such parameter here; there is {}",
        known.join(", ")
    );
    invalid(name, "UNKNOWN_PARAMETER", text)
}

fn read(field: &FieldDescriptor, text: &str) -> Result<Value, Error> {
    if !field.is_list() {
        return value(field, text);
    }
    let values = text.split(',').map(|text| value(field, text));
    values.collect::<Result<_, _>>().map(Value::List)
}

fn value(field: &FieldDescriptor, text: &str) -> Result<Value, Error> {
    let (read, expected) = match field.kind() {
        Kind::Double => (text.parse().ok().map(Value::F64), "a number"),
        Kind::Uint32 => (
            text.parse().ok().map(Value::U32),
            "an integer from 0 to 2^32 - 1",
        ),
        Kind::Uint64 | Kind::Fixed64 => (
            text.parse().ok().map(Value::U64),
            "an integer from 0 to 2^64 - 1",
        ),
        Kind::Bool => match text {
            "" | "true" => (Some(Value::Bool(true)), ""),
            "false" => (Some(Value::Bool(false)), ""),
            _ => (None, "true or false"),
        },
        Kind::String => (Some(Value::String(text.to_owned())), ""),
        Kind::Enum(names) => {
            let number = named(&names, text, &Path::of(field.name()))?;
            (Some(Value::EnumNumber(number)), "")
        }
        _ => (None, "what a parameter can say"),
    };
    read.ok_or_else(|| invalid(field.name(), "TYPE", format!("{text:?} is not {expected}")))
}
