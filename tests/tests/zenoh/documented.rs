//! The examples of the documentation are requests that a server takes, and the answers that it gives.

use serde_json::{Value, json};

use crate::robot::{Robot, server_with};

const PAGE: &str = include_str!("../../../docs/zenoh.md");

/// A state of the documented space.
const POSE: [f64; 7] = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];

/// The first code in a cell of a table, as JSON; `…` becomes a string, also as an object's name.
fn code(cell: &str) -> Value {
    let Some(code) = cell.split('`').nth(1) else {
        return Value::Null;
    };
    let code = code.replace("[…]", r#"["…"]"#);
    let code = code
        .replace("{…}", r#"{"…":0}"#)
        .replace(",…}", r#","…":0}"#);
    serde_json::from_str(&code).unwrap_or_else(|error| panic!("{code}: {error}"))
}

/// Puts a state and a uid in the places of `…`.
fn fill(request: &mut Value, uid: &str) {
    match request {
        Value::Array(rows) if *rows == ["…"] => *request = json!(POSE),
        Value::Array(parts) => parts.iter_mut().for_each(|part| fill(part, uid)),
        Value::Object(fields) => fields.values_mut().for_each(|field| fill(field, uid)),
        Value::String(text) if text == "…" => *text = uid.into(),
        _ => {}
    }
}

/// True if the answer is the documented one; `…` stands for anything.
fn matches(documented: &Value, answer: &Value) -> bool {
    match (documented, answer) {
        (Value::String(text), Value::String(_)) if text == "…" => true,
        (Value::Array(parts), Value::Array(_)) if *parts == ["…"] => true,
        (Value::Array(parts), Value::Array(found)) => {
            let mut pairs = parts.iter().zip(found);
            parts.len() == found.len() && pairs.all(|(part, found)| matches(part, found))
        }
        (Value::Object(fields), Value::Object(found)) => {
            let named = || fields.iter().filter(|(name, _)| *name != "…");
            let is_whole = named().count() == fields.len();
            named().all(|(name, field)| found.get(name).is_some_and(|found| matches(field, found)))
                && (!is_whole || fields.len() == found.len())
        }
        _ => documented == answer,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_examples_run_from_the_first_to_the_last() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().to_str().unwrap();
    let (_server, locator) = server_with(&[], &[("WAYFOLD_DATA__DIR", data)]);
    let robot = Robot::connect(&locator).await;
    let (_, table) = PAGE
        .split_once("| key | request | answer |\n|---|---|---|\n")
        .unwrap();
    let (table, text) = table.split_once("\n\n").unwrap();
    let mut uid = String::new();
    for row in table.lines() {
        let cells: Vec<&str> = row.trim_matches('|').split(" | ").collect();
        let [key, request, answer] = cells[..] else {
            panic!("{row}");
        };
        let key = key.trim().trim_matches('`');
        let mut request = code(request);
        fill(&mut request, &uid);
        let found = robot.json(key, request).await;
        let found = found.unwrap_or_else(|refusal| panic!("{row}: {refusal}"));
        assert!(matches(&code(answer), &found), "{row}\nanswers {found}");
        if key == "create" {
            uid = found["index"]["revision"]["uid"].as_str().unwrap().into();
            // The selector with parameters, on one bare row.
            let selector = text.split('`').find(|code| code.starts_with("arm/knn?"));
            robot.json(selector.unwrap(), json!(POSE)).await.unwrap();
        }
    }
}
