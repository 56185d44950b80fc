//! The parameters of a selector set fields of a request: `?k=10;r=0.5;eps=0;include=states,tags`.

use prost::Message;
use prost_reflect::{
    DynamicMessage, FieldDescriptor, Kind, MessageDescriptor, ReflectMessage, Value,
};

use super::{
    invalid,
    path::Path,
    read::{ambiguous, named, rival},
    schema::special,
};
use crate::service::Error;

/// Short names of fields. A field of the same name takes precedence.
pub(in crate::verbs) const SHORT: [(&str, &str); 5] = [
    ("r", "radius"),
    ("eps", "epsilon"),
    ("from", "after_revision.number"),
    ("uid", "after_revision.uid"),
    ("space", "space_text"),
];

/// Sets the fields that parameters name. A parameter may repeat but not change a field of the message: one that is set,
/// or one that the message names with its default value.
pub(super) fn apply(
    message: &mut DynamicMessage,
    named: &[String],
    parameters: &[(&str, &str)],
) -> Result<(), Error> {
    let mut set = Vec::new();
    for (name, text) in parameters {
        let descriptor = message.descriptor();
        let Some((full, parent, field)) = resolve(&descriptor, name) else {
            return Err(unknown(&descriptor, name));
        };
        let value = read(&field, text)?;
        let holder = match &parent {
            None => &mut *message,
            Some(parent) => match message.get_field_mut(parent) {
                Value::Message(holder) => holder,
                _ => return Err(unknown(&descriptor, name)),
            },
        };
        if let Some(rival) = rival(holder, &field) {
            return Err(ambiguous(&Path::of(&full), &rival));
        }
        let is_set = holder.has_field(&field) || named.contains(&full) || set.contains(&full);
        if is_set && !is_same(&holder.get_field(&field), &value) {
            let text = format!("the parameter {name}={text} and the rest of the query disagree");
            return Err(invalid(full, "CONFLICT", text));
        }
        holder.set_field(&field, value);
        set.push(full);
    }
    Ok(())
}

/// True if two values are equal. In a message, a field with its default value equals an unset one.
fn is_same(one: &Value, other: &Value) -> bool {
    match (one, other) {
        (Value::Message(one), Value::Message(other)) => {
            one.encode_to_vec() == other.encode_to_vec()
        }
        (one, other) => one == other,
    }
}

/// The path, the submessage if any, and the field of the request that a parameter sets.
fn resolve(
    request: &MessageDescriptor,
    name: &str,
) -> Option<(String, Option<FieldDescriptor>, FieldDescriptor)> {
    let settable =
        |fields: &MessageDescriptor, name: &str| fields.get_field_by_name(name).filter(can_be_set);
    if let Some(field) = settable(request, name) {
        return Some((name.to_owned(), None, field));
    }
    let (_, full) = SHORT.iter().find(|(short, _)| *short == name)?;
    let Some((parent, last)) = full.split_once('.') else {
        return Some(((*full).to_owned(), None, settable(request, full)?));
    };
    let parent = request.get_field_by_name(parent)?;
    let Kind::Message(fields) = parent.kind() else {
        return None;
    };
    let field = settable(&fields, last)?;
    Some(((*full).to_owned(), Some(parent), field))
}

/// True if a parameter can hold the field's value. The key names the index, except that of `delete`.
fn can_be_set(field: &FieldDescriptor) -> bool {
    let is_short = match field.kind() {
        Kind::Message(fields) => fields.full_name() == special::INCLUDE,
        Kind::Bytes => false,
        _ => true,
    };
    let is_in_key =
        field.name() == "index_name" && field.parent_message().full_name() != special::DELETE_INDEX;
    is_short && !is_in_key
}

fn unknown(request: &MessageDescriptor, name: &str) -> Error {
    let direct = request.fields().filter(can_be_set);
    let direct = direct.map(|field| field.name().to_owned());
    let short = SHORT.iter().filter_map(|(short, full)| {
        let (resolved, ..) = resolve(request, short)?;
        (resolved == *full).then(|| format!("{short} ({full})"))
    });
    let known = direct.chain(short).chain(["timeout_ms".to_owned()]);
    let text = format!(
        "there is no such parameter here; there is {}",
        known.collect::<Vec<_>>().join(", ")
    );
    invalid(name, "UNKNOWN_PARAMETER", text)
}

fn read(field: &FieldDescriptor, text: &str) -> Result<Value, Error> {
    if let Kind::Message(columns) = field.kind() {
        return include(&columns, text).map(Value::Message);
    }
    if !field.is_list() {
        return value(field, text);
    }
    let values = text.split(',').map(|text| value(field, text));
    values.collect::<Result<_, _>>().map(Value::List)
}

/// The named columns, separated by commas: `tags` sets `with_tags`.
fn include(columns: &MessageDescriptor, text: &str) -> Result<DynamicMessage, Error> {
    const COLUMN: &str = "with_";
    let mut include = DynamicMessage::new(columns.clone());
    for name in text.split(',').filter(|name| !name.is_empty()) {
        let Some(column) = columns.get_field_by_name(&format!("{COLUMN}{name}")) else {
            let known = columns
                .fields()
                .map(|field| field.name().replacen(COLUMN, "", 1));
            let known = known.collect::<Vec<_>>().join(", ");
            let text = format!("{name:?} is none of {known}");
            return Err(invalid("include", "UNKNOWN_VALUE", text));
        };
        include.set_field(&column, Value::Bool(true));
    }
    Ok(include)
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
