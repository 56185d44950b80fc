//! Merges the layers of settings. Every setting has a default, which defines its name and type. Each value is checked
//! against its default before the merge, so that an error can name the layer it came from.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use config::{File, FileFormat, Source, Value, ValueKind};
use wayfold_index::ForestOptions;

use super::{Config, ConfigError, DEFAULTS, OFF, ON, nearest::nearest};
use crate::redact;

const PREFIX: &str = "WAYFOLD_";
const SEPARATOR: &str = "__";

/// The least `limits.max_answer_bytes`: a part of a stream has half of it, and one point more, which may have 64 KiB of
/// payload.
const MIN_ANSWER_BYTES: i64 = 256 * 1024;

/// The most `index.merge_threads`, which shares out the memory for merges.
const MAX_MERGE_THREADS: i64 = 1024;

/// The most `snapshot.every_seconds`, a hundred years: so long ago there is a date with a year of four digits.
const MAX_SNAPSHOT_SECONDS: i64 = 100 * 365 * 24 * 60 * 60;

/// Settings that may be 0; `default.toml` says what 0 means for each.
const MAY_BE_ZERO: [&str; 12] = [
    "disk.min_free_bytes",
    "index.growing_rows",
    "grpc.keepalive_interval_ms",
    "limits.max_operations",
    "limits.max_operation_bytes",
    "limits.max_payload_bytes_per_index",
    "limits.max_points_per_index",
    "limits.max_state_bytes_per_index",
    "log.slow_call_ms",
    "memory.limit_bytes",
    "runtime.workers",
    "shutdown.grace_ms",
];

/// Settings that are either [`ON`] or [`OFF`].
const SWITCHES: [&str; 2] = ["access.insecure", "access.publish_events"];

/// Settings by dotted key.
type Settings = BTreeMap<String, Value>;

/// See [`Config::load`].
pub(super) fn load(
    file: Option<&Path>,
    environment: &BTreeMap<String, String>,
    flags: &[(&str, String)],
) -> Result<Config, ConfigError> {
    let defaults = toml("default.toml", DEFAULTS)?;
    let mut settings = defaults.clone();
    if let Some(path) = file {
        let origin = path.display().to_string();
        let text = fs::read_to_string(path).map_err(|source| ConfigError::Read {
            file: PathBuf::from(path),
            source,
        })?;
        overlay(&mut settings, &defaults, &origin, toml(&origin, &text)?)?;
    }
    for (name, value) in environment {
        let Some(key) = key_of_variable(name, &defaults)? else {
            continue;
        };
        let origin = format!("environment variable {name}");
        let layer = typed_text(&origin, key, value, &defaults)?;
        overlay(&mut settings, &defaults, &origin, layer)?;
    }
    for (key, value) in flags {
        let layer = typed_text("command line", (*key).to_owned(), value, &defaults)?;
        overlay(&mut settings, &defaults, "command line", layer)?;
    }
    build(settings)
}

/// The settings in TOML text.
fn toml(origin: &str, text: &str) -> Result<Settings, ConfigError> {
    let table = File::from_str(text, FileFormat::Toml)
        .collect()
        .map_err(|problem| ConfigError::Syntax {
            origin: origin.to_owned(),
            problem: match &problem {
                config::ConfigError::FileParse { cause, .. } => match cause.downcast_ref() {
                    Some(error) => redact::toml(error, text),
                    None => cause.to_string(),
                },
                other => other.to_string(),
            },
        })?;
    let mut settings = Settings::new();
    for (key, value) in table {
        flatten(key, value, &mut settings);
    }
    Ok(settings)
}

fn flatten(key: String, value: Value, settings: &mut Settings) {
    match value.kind {
        ValueKind::Table(table) if !table.is_empty() => {
            for (inner, value) in table {
                flatten(format!("{key}.{inner}"), value, settings);
            }
        }
        // An empty section sets nothing; it is kept so that an unknown name is still refused.
        _ => {
            settings.insert(key, value);
        }
    }
}

/// The key that an environment variable sets, or None for a variable of another program.
fn key_of_variable(name: &str, defaults: &Settings) -> Result<Option<String>, ConfigError> {
    let Some(written) = name.strip_prefix(PREFIX) else {
        return Ok(None);
    };
    if !written.contains(SEPARATOR) {
        // Wayfold's other programs read variables with this prefix, so only a near match is an error.
        let collapsed = |key: &&String| key.replace('.', "_").eq_ignore_ascii_case(written);
        return match defaults.keys().find(collapsed) {
            Some(key) => Err(ConfigError::Unknown {
                origin: "environment".to_owned(),
                key: name.to_owned(),
                nearest: variable_of_key(key),
            }),
            None => Ok(None),
        };
    }
    let key = written.to_ascii_lowercase().replace(SEPARATOR, ".");
    if !defaults.contains_key(&key) {
        return Err(ConfigError::Unknown {
            origin: "environment".to_owned(),
            key: name.to_owned(),
            nearest: nearest(&key, defaults.keys().map(String::as_str))
                .map_or_else(String::new, variable_of_key),
        });
    }
    Ok(Some(key))
}

fn variable_of_key(key: &str) -> String {
    format!("{PREFIX}{}", key.replace('.', SEPARATOR).to_uppercase())
}

/// A layer of one value, parsed from text as the type of its default.
fn typed_text(
    origin: &str,
    key: String,
    text: &str,
    defaults: &Settings,
) -> Result<Settings, ConfigError> {
    let kind = match defaults.get(&key).map(|value| &value.kind) {
        Some(ValueKind::I64(_)) => match text.parse() {
            Ok(number) => ValueKind::I64(number),
            Err(_) => {
                return Err(ConfigError::Type {
                    origin: origin.to_owned(),
                    key,
                    expected: "an integer",
                    found: format!("\"{text}\""),
                });
            }
        },
        _ => ValueKind::String(text.to_owned()),
    };
    Ok(Settings::from([(key, Value::new(None, kind))]))
}

/// Checks each value of `layer` against its default, then lets it override `settings`.
fn overlay(
    settings: &mut Settings,
    defaults: &Settings,
    origin: &str,
    layer: Settings,
) -> Result<(), ConfigError> {
    for (key, value) in layer {
        let is_section = |known: &String| known.starts_with(&format!("{key}."));
        if matches!(value.kind, ValueKind::Table(_)) && defaults.keys().any(is_section) {
            continue;
        }
        let Some(default) = defaults.get(&key) else {
            return Err(ConfigError::Unknown {
                origin: origin.to_owned(),
                nearest: nearest(&key, defaults.keys().map(String::as_str))
                    .unwrap_or_default()
                    .to_owned(),
                key,
            });
        };
        check(origin, &key, default, &value)?;
        let value = Value::new(Some(&origin.to_owned()), value.kind);
        settings.insert(key, value);
    }
    Ok(())
}

fn check(origin: &str, key: &str, default: &Value, value: &Value) -> Result<(), ConfigError> {
    let (expected, found) = match (&default.kind, &value.kind) {
        (ValueKind::I64(_), ValueKind::I64(number)) => {
            let least = match key {
                "limits.max_answer_bytes" => MIN_ANSWER_BYTES,
                // One place for streams, and one for calls that end.
                "grpc.max_calls_per_connection" => 2,
                _ => i64::from(!MAY_BE_ZERO.contains(&key)),
            };
            let most = match key {
                "index.growing_rows" => ForestOptions::MAX_GROWING_ROWS as i64,
                "index.merge_threads" => MAX_MERGE_THREADS,
                "snapshot.every_seconds" => MAX_SNAPSHOT_SECONDS,
                // The length of a message has 32 bits.
                "grpc.max_message_bytes" | "zenoh.max_message_bytes" => i64::from(u32::MAX),
                _ if key.ends_with("_percent") => 100,
                _ => i64::MAX,
            };
            let problem = if *number < least {
                format!("{number} is too small; at least {least}")
            } else if *number > most {
                format!("{number} is too large; at most {most}")
            } else {
                return Ok(());
            };
            return Err(ConfigError::Value {
                origin: origin.to_owned(),
                key: key.to_owned(),
                problem,
            });
        }
        (ValueKind::String(_), ValueKind::String(text)) => {
            // NATS takes no other names of streams and buckets.
            let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_".contains(&byte);
            let problem = if text.is_empty() {
                "it is empty; leave the setting out to get the default".to_owned()
            } else if SWITCHES.contains(&key) && text != ON && text != OFF {
                format!("\"{text}\" is neither \"{ON}\" nor \"{OFF}\"")
            } else if key == "cluster.name" && !text.bytes().all(is_plain) {
                format!("\"{text}\" has more than letters of ASCII, digits, - and _")
            } else {
                return Ok(());
            };
            return Err(ConfigError::Value {
                origin: origin.to_owned(),
                key: key.to_owned(),
                problem,
            });
        }
        (ValueKind::I64(_), ValueKind::String(text)) => ("an integer", format!("\"{text}\"")),
        (ValueKind::I64(_), other) => ("an integer", other.to_string()),
        // Texts may hold secrets, also in a value of another type.
        (_, ValueKind::Array(_)) => ("a string", "an array".to_owned()),
        (_, ValueKind::Table(_)) => ("a string", "a table".to_owned()),
        (_, ValueKind::Boolean(_)) => ("a string", "a boolean".to_owned()),
        _ => ("a string", "a number".to_owned()),
    };
    Err(ConfigError::Type {
        origin: origin.to_owned(),
        key: key.to_owned(),
        expected,
        found,
    })
}

/// The typed settings. A value outside the range of its type can still fail here.
fn build(settings: Settings) -> Result<Config, ConfigError> {
    let mut builder = config::Config::builder();
    for (key, value) in &settings {
        builder = builder
            .set_override(key, value.clone())
            .map_err(|problem| value_error(&settings, problem))?;
    }
    builder
        .build()
        .and_then(config::Config::try_deserialize)
        .map_err(|problem| value_error(&settings, problem))
}

fn value_error(settings: &Settings, problem: config::ConfigError) -> ConfigError {
    use config::ConfigError as Problem;
    let (key, problem) = match problem {
        Problem::At { error, key, .. } => (key, error.to_string()),
        Problem::Type {
            unexpected,
            expected,
            key,
            ..
        } => (key, format!("{unexpected} is not {expected}")),
        other => (None, other.to_string()),
    };
    let key = key.unwrap_or_default();
    let origin = settings.get(&key).and_then(Value::origin);
    ConfigError::Value {
        origin: origin.unwrap_or("settings").to_owned(),
        key,
        problem,
    }
}
