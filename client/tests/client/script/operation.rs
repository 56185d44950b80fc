//! The lines of the script: an operation, ` = `, and its answer.

use std::{fmt::Write, str::FromStr};

use wayfold::Neighbor;

/// One operation on an index.
#[derive(Clone, Debug)]
pub(crate) enum Operation {
    /// The operations from here on are those of a new index of this space.
    Space(String),
    Insert(Vec<f64>),
    /// The id is the caller's, or one that the index assigns.
    InsertWith {
        id: Option<u64>,
        tag: u64,
        state: Vec<f64>,
    },
    InsertMany(Vec<Vec<f64>>),
    Replace {
        id: u64,
        state: Vec<f64>,
    },
    Remove {
        id: u64,
    },
    SetTag {
        id: u64,
        tag: u64,
    },
    Get {
        id: u64,
    },
    Len,
    Nearest(Vec<f64>),
    NearestK {
        k: u32,
        state: Vec<f64>,
    },
    NearestR {
        radius: f64,
        state: Vec<f64>,
    },
    Search {
        /// `None` is without a limit.
        k: Option<u32>,
        radius: f64,
        tag_mask: u64,
        tag_value: u64,
        epsilon: f64,
        state: Vec<f64>,
    },
}

impl Operation {
    /// The operation of a line without its answer; `None` for an empty line and a comment.
    pub(crate) fn parse(line: &str) -> Option<Operation> {
        let line = line.split(" = ").next().unwrap_or_default();
        let mut words = line.split_whitespace();
        let name = words.next().filter(|name| !name.starts_with('#'))?;
        Some(match name {
            "space" => Operation::Space(line["space ".len()..].to_owned()),
            "insert" => Operation::Insert(rest(words)),
            "insert_with" => Operation::InsertWith {
                id: optional(&mut words),
                tag: next(&mut words),
                state: rest(words),
            },
            "insert_many" => {
                let count: usize = next(&mut words);
                let numbers = rest(words);
                let rows = numbers.chunks_exact(numbers.len() / count);
                Operation::InsertMany(rows.map(<[f64]>::to_vec).collect())
            }
            "replace" => Operation::Replace {
                id: next(&mut words),
                state: rest(words),
            },
            "remove" => Operation::Remove {
                id: next(&mut words),
            },
            "set_tag" => Operation::SetTag {
                id: next(&mut words),
                tag: next(&mut words),
            },
            "get" => Operation::Get {
                id: next(&mut words),
            },
            "len" => Operation::Len,
            "nearest" => Operation::Nearest(rest(words)),
            "nearest_k" => Operation::NearestK {
                k: next(&mut words),
                state: rest(words),
            },
            "nearest_r" => Operation::NearestR {
                radius: next(&mut words),
                state: rest(words),
            },
            "search" => Operation::Search {
                k: optional(&mut words),
                radius: next(&mut words),
                tag_mask: next(&mut words),
                tag_value: next(&mut words),
                epsilon: next(&mut words),
                state: rest(words),
            },
            other => panic!("{other}: no operation"),
        })
    }
}

fn parse<T: FromStr>(word: &str) -> T {
    let parsed = word.parse();
    parsed.unwrap_or_else(|_| panic!("{word:?}: not a number of this kind"))
}

fn next<'a, T: FromStr>(words: &mut impl Iterator<Item = &'a str>) -> T {
    parse(words.next().unwrap_or_default())
}

/// A number, or `-` for none.
fn optional<'a, T: FromStr>(words: &mut impl Iterator<Item = &'a str>) -> Option<T> {
    let word = words.next().unwrap_or_default();
    (word != "-").then(|| parse(word))
}

fn rest<'a>(words: impl Iterator<Item = &'a str>) -> Vec<f64> {
    words.map(parse).collect()
}

/// The answer to an operation.
#[derive(Debug)]
pub(crate) enum Answer {
    Done(bool),
    Number(u64),
    Ids(Vec<u64>),
    Point(Option<(u64, Vec<f64>)>),
    Neighbors(Vec<Neighbor>),
    Refused { code: &'static str, message: String },
}

impl Answer {
    /// The text of the answer: the numbers of states and the distances are their 64 bits.
    pub(crate) fn text(&self) -> String {
        let mut words = Vec::new();
        match self {
            Answer::Done(done) => return done.to_string(),
            Answer::Number(number) => return number.to_string(),
            Answer::Refused { code, message } => return format!("{code} {message}"),
            Answer::Ids(ids) => words.extend(ids.iter().map(u64::to_string)),
            Answer::Point(None) => {}
            Answer::Point(Some((tag, row))) => {
                words.push(tag.to_string());
                words.extend(
                    row.iter()
                        .map(|number| format!("{:016x}", number.to_bits())),
                );
            }
            Answer::Neighbors(neighbors) => {
                let pairs = neighbors.iter();
                words.extend(
                    pairs.map(|near| format!("{}:{:016x}", near.id, near.distance.to_bits())),
                );
            }
        }
        match words.is_empty() {
            true => "none".to_owned(),
            false => words.join(" "),
        }
    }
}

/// The script with other answers. `answer` returns none for a space.
pub(crate) fn with_answers(
    script: &str,
    mut answer: impl FnMut(Operation) -> Option<Answer>,
) -> String {
    let mut text = String::new();
    for line in script.lines() {
        match Operation::parse(line) {
            None => text.push_str(line),
            Some(operation) => {
                text.push_str(line.split(" = ").next().unwrap_or_default());
                if let Some(answer) = answer(operation) {
                    let _ = write!(text, " = {}", answer.text());
                }
            }
        }
        text.push('\n');
    }
    text
}
