//! Requests in handwritten JSON, and the answers in JSON, read field by field.

use base64::prelude::{BASE64_STANDARD, Engine as _};
use serde_json::{Map, Value, json};
use wayfold_proto::v1::{self, create_index_request::SpaceForm, neighbor_spec};

use super::{op::Op, sessions, target::Answer};

fn float(value: f64) -> Value {
    match value {
        _ if value.is_nan() => json!("NaN"),
        f64::INFINITY => json!("Infinity"),
        f64::NEG_INFINITY => json!("-Infinity"),
        _ => json!(value),
    }
}

/// Writes a 64-bit integer as text, like a program whose readers have only doubles.
pub(super) fn integer(value: &u64) -> Value {
    match *value {
        large if large >= 1 << 53 => json!(large.to_string()),
        value => json!(value),
    }
}

pub(super) fn integers(values: &[u64]) -> Value {
    values.iter().map(integer).collect()
}

pub(super) fn payloads<B: AsRef<[u8]>>(values: &[B]) -> Value {
    let texts = values.iter().map(|bytes| BASE64_STANDARD.encode(bytes));
    texts.collect()
}

pub(super) fn states(states: &v1::States) -> Value {
    let numbers: Vec<Value> = states.coordinates.iter().copied().map(float).collect();
    let rows = states.row_count as usize;
    if rows == 0 && numbers.is_empty() {
        return json!([]);
    }
    if rows == 0 || !numbers.len().is_multiple_of(rows) || numbers.is_empty() {
        return json!({ "row_count": rows, "coordinates": numbers });
    }
    numbers
        .chunks(numbers.len() / rows)
        .map(|row| json!(row))
        .collect()
}

fn filter(filter: &v1::Filter) -> Value {
    let mut it = json!({
        "tag_mask": integer(&filter.tag_mask),
        "tag_value": integer(&filter.tag_value),
    });
    if let Some(since) = &filter.since_revision {
        it["since_revision"] = revision(since);
    }
    it
}

fn include(it: &v1::Include) -> Value {
    json!({ "with_states": it.with_states, "with_tags": it.with_tags, "with_revisions": it.with_revisions, "with_payloads": it.with_payloads })
}

fn revision(it: &v1::Revision) -> Value {
    json!({ "uid": it.uid, "number": integer(&it.number) })
}

/// The name and value of the field of a oneof that is set.
fn count(it: neighbor_spec::KForm) -> (&'static str, Option<Value>) {
    match it {
        neighbor_spec::KForm::K(k) => ("k", Some(json!(k))),
        neighbor_spec::KForm::KFactor(factor) => ("k_factor", Some(float(factor))),
    }
}

fn radius_form(it: neighbor_spec::RadiusForm) -> (&'static str, Option<Value>) {
    match it {
        neighbor_spec::RadiusForm::Radius(radius) => ("radius", Some(float(radius))),
        neighbor_spec::RadiusForm::ScaledRadius(it) => {
            let scaled = object([
                ("factor", Some(float(it.factor))),
                ("max", it.max.map(float)),
            ]);
            ("scaled_radius", Some(scaled))
        }
    }
}

const UNSET: (&str, Option<Value>) = ("", None);

/// The fields that are set.
pub(super) fn object<const N: usize>(fields: [(&str, Option<Value>); N]) -> Value {
    let set = fields.into_iter();
    let set = set.filter_map(|(name, value)| Some((name.to_owned(), value?)));
    Value::Object(set.collect::<Map<_, _>>())
}

/// A request without the name of the index, which is in the key, unless the operation addresses the server.
pub(super) fn request(op: &Op) -> Value {
    match op {
        Op::Create(it) => object([
            ("name", Some(json!(it.name))),
            match &it.space_form {
                Some(SpaceForm::SpaceText(text)) => ("space_text", Some(json!(text))),
                Some(SpaceForm::Space(_)) => ("space", Some(json!({ "so3": {} }))),
                None => UNSET,
            },
        ]),
        Op::Info(_) => json!({}),
        Op::List(it) => json!({ "page_size": it.page_size, "page_token": it.page_token }),
        Op::Delete(it) => json!({ "index_name": it.index_name, "uid": it.uid }),
        Op::Insert(it) => object([
            ("states", it.states.as_ref().map(states)),
            ("ids", Some(integers(&it.ids))),
            ("tags", Some(integers(&it.tags))),
            ("payloads", Some(payloads(&it.payloads))),
            (
                "on_conflict",
                Some(if it.on_conflict == 2 {
                    json!("REPLACE")
                } else {
                    json!(it.on_conflict)
                }),
            ),
            ("min_separation", Some(float(it.min_separation))),
            (
                "neighbor_spec",
                it.neighbor_spec.as_ref().map(|it| {
                    object([
                        it.k_form.map_or(UNSET, count),
                        it.radius_form.map_or(UNSET, radius_form),
                        ("filter", it.filter.as_ref().map(filter)),
                        ("include", it.include.as_ref().map(include)),
                    ])
                }),
            ),
            ("operation_id", Some(json!(it.operation_id))),
            ("uid", Some(json!(it.uid))),
        ]),
        Op::Update(it) => object([
            ("ids", Some(integers(&it.ids))),
            ("tags", Some(integers(&it.tags))),
            ("tag_mask", it.tag_mask.as_ref().map(integer)),
            ("payloads", Some(payloads(&it.payloads))),
            ("if_revision", it.if_revision.as_ref().map(revision)),
            ("operation_id", Some(json!(it.operation_id))),
            ("uid", Some(json!(it.uid))),
        ]),
        Op::Remove(it) => json!({
            "ids": integers(&it.ids), "operation_id": it.operation_id, "uid": it.uid
        }),
        Op::OpenSession(it) => sessions::opening(it),
        Op::Write(it) => sessions::batch(it),
        Op::Get(it) => object([
            ("ids", Some(integers(&it.ids))),
            ("include", it.include.as_ref().map(include)),
            ("min_revision", it.min_revision.as_ref().map(revision)),
        ]),
        Op::Knn(it) => object([
            ("states", it.states.as_ref().map(states)),
            it.k_form.map_or(UNSET, |it| count(it.into())),
            it.radius_form.map_or(UNSET, |it| radius_form(it.into())),
            ("epsilon", Some(float(it.epsilon))),
            ("filter", it.filter.as_ref().map(filter)),
            ("include", it.include.as_ref().map(include)),
            ("min_revision", it.min_revision.as_ref().map(revision)),
        ]),
        Op::Query(it) => object([
            ("states", it.states.as_ref().map(states)),
            it.radius_form.map_or(UNSET, |it| radius_form(it.into())),
            ("epsilon", Some(float(it.epsilon))),
            ("filter", it.filter.as_ref().map(filter)),
            ("include", it.include.as_ref().map(include)),
            ("min_revision", it.min_revision.as_ref().map(revision)),
        ]),
        Op::Log(it) => object([
            ("after_revision", it.after_revision.as_ref().map(revision)),
            ("include", it.include.as_ref().map(include)),
            ("own_session", Some(integer(&it.own_session))),
        ]),
    }
}

pub(super) fn read_integer(value: &Value) -> u64 {
    let number = value.as_u64();
    let number = number.inspect(|number| assert!(*number < 1 << 53, "{number} loses bits"));
    number.unwrap_or_else(|| value.as_str().unwrap().parse().unwrap())
}

fn read_float(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| match value.as_str() {
        Some("Infinity") => f64::INFINITY,
        other => panic!("{other:?}"),
    })
}

fn text(value: &Value) -> String {
    value.as_str().unwrap().to_owned()
}

/// The elements of an array; empty if the value is missing.
fn list<T>(value: &Value, read: impl Fn(&Value) -> T) -> Vec<T> {
    value.as_array().into_iter().flatten().map(read).collect()
}

fn read_rows(rows: &[&Value]) -> v1::States {
    v1::States {
        row_count: rows.len() as u32,
        coordinates: rows.iter().flat_map(|row| list(row, read_float)).collect(),
    }
}

fn read_states(value: &Value) -> Option<v1::States> {
    let rows: Vec<&Value> = value.as_array()?.iter().collect();
    Some(read_rows(&rows))
}

fn read_neighbors(it: &Value) -> v1::Neighbors {
    fn flat<T>(column: &Value, read: impl Fn(&Value) -> T) -> Vec<T> {
        let rows = column.as_array().into_iter().flatten();
        rows.flat_map(|row| list(row, &read)).collect()
    }
    let states = it["states"].as_array().map(|groups| {
        let rows: Vec<&Value> = groups
            .iter()
            .flat_map(|rows| rows.as_array().unwrap())
            .collect();
        read_rows(&rows)
    });
    v1::Neighbors {
        neighbor_counts: list(&it["ids"], |row| row.as_array().unwrap().len() as u32),
        ids: flat(&it["ids"], read_integer),
        distances: flat(&it["distances"], read_float),
        states,
        tags: flat(&it["tags"], read_integer),
        revisions: flat(&it["revisions"], read_integer),
        payloads: flat(&it["payloads"], |it| {
            BASE64_STANDARD.decode(it.as_str().unwrap()).unwrap().into()
        }),
    }
}

fn read_points(it: &Value) -> v1::Points {
    v1::Points {
        ids: list(&it["ids"], read_integer),
        states: read_states(&it["states"]),
        tags: list(&it["tags"], read_integer),
        revisions: list(&it["revisions"], read_integer),
        payloads: list(&it["payloads"], |it| {
            BASE64_STANDARD.decode(it.as_str().unwrap()).unwrap().into()
        }),
    }
}

pub(super) fn read_revision(it: &Value) -> Option<v1::Revision> {
    Some(v1::Revision {
        uid: text(&it["uid"]),
        number: read_integer(&it["number"]),
    })
}

fn read_index(it: &Value) -> v1::Index {
    // Another test compares the message of a space with its text.
    let space: wayfold_index::Space = text(&it["space_text"]).parse().unwrap();
    assert!(it["space"].is_object());
    v1::Index {
        name: text(&it["name"]),
        space: Some(wayfold_proto::space::to_message(&space)),
        space_text: text(&it["space_text"]),
        revision: read_revision(&it["revision"]),
        point_count: read_integer(&it["point_count"]),
        coordinate_count: read_integer(&it["coordinate_count"]) as u32,
        dimension: read_integer(&it["dimension"]) as u32,
        memory_bytes: 0,
        payload_encoding: Default::default(),
    }
}

/// Reads an answer from its JSON.
pub(super) fn answer(op: &Op, it: &Value) -> Answer {
    let revision = || read_revision(&it["revision"]);
    match op {
        Op::Create(_) => Answer::Create(v1::CreateIndexResponse {
            index: Some(read_index(&it["index"])),
            created: it["created"].as_bool().unwrap(),
        }),
        Op::Info(_) => Answer::Info(v1::GetIndexResponse {
            index: Some(read_index(&it["index"])),
        }),
        Op::List(_) => Answer::List(v1::ListIndexesResponse {
            indexes: list(&it["indexes"], read_index),
            next_page_token: text(&it["next_page_token"]),
            damaged: Vec::new(),
        }),
        Op::Delete(_) => Answer::Delete(v1::DeleteIndexResponse {
            uid: text(&it["uid"]),
        }),
        Op::Insert(_) => Answer::Insert(v1::InsertResponse {
            outcomes: list(&it["outcomes"], |it| {
                let name = format!("OUTCOME_{}", it.as_str().unwrap());
                v1::Outcome::from_str_name(&name).unwrap().into()
            }),
            ids: list(&it["ids"], read_integer),
            neighbors: it.get("neighbors").map(read_neighbors),
            revision: revision(),
        }),
        Op::Update(_) => Answer::Update(v1::UpdateResponse {
            updated_count: read_integer(&it["updated_count"]),
            unchanged_count: read_integer(&it["unchanged_count"]),
            revision: revision(),
        }),
        Op::Remove(_) => Answer::Remove(v1::RemoveResponse {
            removed_count: read_integer(&it["removed_count"]),
            missing_count: read_integer(&it["missing_count"]),
            revision: revision(),
        }),
        Op::OpenSession(_) => sessions::opened(it),
        Op::Write(_) => sessions::written(it),
        Op::Get(_) => Answer::Get(v1::GetResponse {
            points: Some(read_points(&it["points"])),
            revision: revision(),
        }),
        Op::Knn(_) => Answer::Knn(v1::KnnResponse {
            neighbors: Some(read_neighbors(it)),
            revision: revision(),
        }),
        Op::Query(_) => Answer::Query(v1::QueryResponse {
            neighbors: Some(read_neighbors(it)),
            revision: revision(),
        }),
        Op::Log(_) => Answer::Log(v1::WatchResponse {
            revision: revision(),
            mutations: list(&it["mutations"], |it| v1::Mutation {
                revision: read_revision(&it["revision"]),
                time_ms: read_integer(&it["time_ms"]),
                stored: it.get("stored").map(read_points),
                removed_ids: list(&it["removed_ids"], read_integer),
                continued: it["continued"].as_bool().unwrap(),
                piece: u32::try_from(read_integer(&it["piece"])).unwrap(),
                session: read_integer(&it["session"]),
                batch: read_integer(&it["batch"]),
            }),
            reset: it.get("reset").map(|it| {
                let name = format!("RESET_REASON_{}", it.as_str().unwrap());
                v1::ResetReason::from_str_name(&name).unwrap().into()
            }),
        }),
    }
}
