//! Writes a message as JSON.

use base64::{Engine, prelude::BASE64_STANDARD};
use prost_reflect::{
    DynamicMessage, EnumDescriptor, FieldDescriptor, Kind, MapKey, ReflectMessage, Value,
};

use super::schema::{self, special};

/// Integers from here up are written as strings: doubles, which many readers of JSON use, round them.
const EXACT: u64 = 1 << 53;

/// Writes a message.
pub(in crate::verbs) fn json(message: &DynamicMessage) -> String {
    let mut out = Writer(String::new());
    out.message(message);
    out.0
}

struct Writer(String);

impl Writer {
    fn message(&mut self, message: &DynamicMessage) {
        let descriptor = message.descriptor();
        match descriptor.full_name() {
            special::STATES => self.rows(message, None),
            special::ANY => self.any(message),
            _ => {
                self.0.push('{');
                self.fields(message);
                self.0.push('}');
            }
        }
    }

    /// The fields of a message, each after a comma unless it is the first of its object.
    fn fields(&mut self, message: &DynamicMessage) {
        let descriptor = message.descriptor();
        let name = descriptor.full_name();
        if name == special::NEIGHBORS {
            return self.neighbors(message);
        }
        for field in descriptor.fields() {
            let value = message.get_field(&field);
            if special::SEARCH_RESPONSES.contains(&name) && field.name() == "neighbors" {
                if let Value::Message(neighbors) = &*value {
                    self.fields(neighbors);
                }
                continue;
            }
            // This column is absent while others are present.
            let is_left_out = name == special::POINTS && field.name() != "ids" && field.is_list();
            if !is_written(message, &field, &value) || is_left_out && !message.has_field(&field) {
                continue;
            }
            self.name(field.name());
            self.value(&field.kind(), &value);
        }
    }

    fn name(&mut self, name: &str) {
        if !self.0.ends_with('{') {
            self.0.push(',');
        }
        self.string(name);
        self.0.push(':');
    }

    fn value(&mut self, kind: &Kind, value: &Value) {
        match value {
            Value::Bool(value) => self.0.push_str(if *value { "true" } else { "false" }),
            Value::I32(value) => self.0.push_str(&value.to_string()),
            Value::I64(value) => self.integer(value.unsigned_abs(), &value.to_string()),
            Value::U32(value) => self.0.push_str(&value.to_string()),
            Value::U64(value) => self.integer(*value, &value.to_string()),
            Value::F32(value) => self.float(f64::from(*value)),
            Value::F64(value) => self.float(*value),
            Value::String(text) => self.string(text),
            Value::Bytes(bytes) => self.string(&BASE64_STANDARD.encode(bytes)),
            Value::EnumNumber(number) => match kind {
                Kind::Enum(names) => self.named(names, *number),
                _ => self.0.push_str(&number.to_string()),
            },
            Value::Message(message) => self.message(message),
            Value::List(values) => self.list(values, |out, value| out.value(kind, value)),
            Value::Map(entries) => self.map(kind, entries),
        }
    }

    fn list<T>(&mut self, elements: &[T], mut write: impl FnMut(&mut Self, &T)) {
        self.0.push('[');
        for (at, element) in elements.iter().enumerate() {
            if at > 0 {
                self.0.push(',');
            }
            write(self, element);
        }
        self.0.push(']');
    }

    fn map(&mut self, kind: &Kind, entries: &std::collections::HashMap<MapKey, Value>) {
        let mut sorted: Vec<(&str, &Value)> = entries
            .iter()
            .filter_map(|(key, value)| Some((key.as_str()?, value)))
            .collect();
        sorted.sort_by_key(|(key, _)| *key);
        self.0.push('{');
        for (key, value) in sorted {
            self.name(key);
            self.value(kind, value);
        }
        self.0.push('}');
    }

    /// Rows of coordinates, grouped by `counts` if present.
    fn rows(&mut self, states: &DynamicMessage, counts: Option<&[usize]>) {
        let rows = column(states, "row_count");
        let rows = rows.as_ref().and_then(Value::as_u32).unwrap_or(0) as usize;
        let coordinates = column(states, "coordinates");
        let coordinates = coordinates.as_ref().and_then(Value::as_list).unwrap_or(&[]);
        let width = coordinates.len().checked_div(rows).unwrap_or(0);
        let rows: Vec<&[Value]> = (0..rows)
            .map(|row| &coordinates[row * width..][..width])
            .collect();
        let write = |out: &mut Self, row: &&[Value]| {
            out.list(row, |out, value| out.value(&Kind::Double, value));
        };
        match counts {
            None => self.list(&rows, write),
            Some(counts) => {
                let groups = groups(&rows, counts);
                self.list(&groups, |out, group| out.list(group, write));
            }
        }
    }

    /// The columns of neighbours, a row for each state.
    fn neighbors(&mut self, neighbors: &DynamicMessage) {
        let counts = column(neighbors, "neighbor_counts");
        let counts = counts.as_ref().and_then(Value::as_list).unwrap_or(&[]);
        let counts: Vec<usize> = counts
            .iter()
            .map(|count| count.as_u32().unwrap_or(0) as usize)
            .collect();
        for field in neighbors.descriptor().fields() {
            let is_always = matches!(field.name(), "ids" | "distances");
            if field.name() == "neighbor_counts" || !is_always && !neighbors.has_field(&field) {
                continue;
            }
            self.name(field.name());
            let kind = field.kind();
            match &*neighbors.get_field(&field) {
                Value::Message(states) => self.rows(states, Some(&counts)),
                Value::List(values) => {
                    let groups = groups(values, &counts);
                    self.list(&groups, |out, group| {
                        out.list(group, |out, value| out.value(&kind, value));
                    });
                }
                other => self.value(&kind, other),
            }
        }
    }

    /// A detail of an error, with its type; for an unknown type only that.
    fn any(&mut self, any: &DynamicMessage) {
        let url = column(any, "type_url");
        let url = url.as_ref().and_then(Value::as_str).unwrap_or_default();
        self.0.push('{');
        self.name("@type");
        self.string(url);
        let bytes = column(any, "value");
        let bytes = bytes.as_ref().and_then(Value::as_bytes).cloned();
        let message = schema::detail(url)
            .and_then(|detail| DynamicMessage::decode(detail, bytes.unwrap_or_default()).ok());
        if let Some(message) = message {
            self.fields(&message);
        }
        self.0.push('}');
    }

    fn named(&mut self, names: &EnumDescriptor, number: i32) {
        match names.get_value(number) {
            Some(value) => {
                let prefix = schema::prefix(names);
                let name = value.name();
                self.string(name.strip_prefix(&prefix).unwrap_or(name));
            }
            None => self.0.push_str(&number.to_string()),
        }
    }

    fn integer(&mut self, magnitude: u64, digits: &str) {
        if magnitude < EXACT {
            self.0.push_str(digits);
        } else {
            self.string(digits);
        }
    }

    /// The shortest digits that read back to the same bits.
    fn float(&mut self, value: f64) {
        match serde_json::Number::from_f64(value) {
            Some(number) => self.0.push_str(&number.to_string()),
            None if value.is_nan() => self.string("NaN"),
            None if value > 0.0 => self.string("Infinity"),
            None => self.string("-Infinity"),
        }
    }

    fn string(&mut self, text: &str) {
        self.0.push_str(&serde_json::Value::from(text).to_string());
    }
}

/// True if a field is written: an unset field with presence is not, nor is the zero value of an enumeration.
fn is_written(message: &DynamicMessage, field: &FieldDescriptor, value: &Value) -> bool {
    let unspecified = !field.is_list() && matches!(value, Value::EnumNumber(0));
    message.has_field(field) || !field.supports_presence() && !unspecified
}

fn column(message: &DynamicMessage, name: &str) -> Option<Value> {
    message
        .get_field_by_name(name)
        .map(|value| value.into_owned())
}

/// The elements in groups of the given counts. Elements beyond the counts are left out; no message has any.
fn groups<'a, T>(elements: &'a [T], counts: &[usize]) -> Vec<&'a [T]> {
    let mut rest = elements;
    let take = |count: &usize| {
        let (group, after) = rest.split_at((*count).min(rest.len()));
        rest = after;
        group
    };
    counts.iter().map(take).collect()
}
