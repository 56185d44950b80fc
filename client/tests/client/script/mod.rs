//! The script `client/tests/script/operations.txt`: brute force writes its answers, and each form of the index gives them.
//!
//! The programs of C++ and Python replay the same file.

mod operation;
mod oracle;

use std::time::Duration;

use wayfold::{Code, Error, Index, InsertOptions, Neighbor, Search, Space};

use crate::server::Server;
use operation::{Answer, Operation, with_answers};
use oracle::Oracle;

/// The longest time until a server has all writes.
const MAX_WAIT: Duration = Duration::from_secs(30);
const SCRIPT: &str = include_str!("../../script/operations.txt");

/// Writes the answers of changed operations, if the variable has the file.
#[test]
fn its_answers_are_those_of_brute_force() {
    let mut oracle = Oracle::new(&Space::se2());
    let expected = with_answers(SCRIPT, |operation| oracle.answer(operation));
    if let Some(file) = std::env::var_os("WRITE_SCRIPT") {
        std::fs::write(file, expected).unwrap();
        return;
    }
    assert_same(SCRIPT, &expected);
}

#[test]
fn in_memory() {
    replay(|space, _| Index::in_memory(space).unwrap());
}

#[test]
fn in_memory_where_inserts_merge() {
    replay(|space, _| Index::in_memory_inline(space).unwrap());
}

#[test]
fn shared() {
    let server = Server::start();
    replay(|space, name| {
        let index = Index::shared(&server.uri, name).create(space);
        index.open().unwrap()
    });
}

#[test]
fn remote() {
    let server = Server::start();
    replay(|space, name| {
        let index = Index::remote(&server.uri, name).create(space);
        index.open().unwrap()
    });
}

/// Gives all operations to the indices that `make` makes of a space and a name.
fn replay(make: impl Fn(&Space, &str) -> Index) {
    let mut indices: Vec<Index> = Vec::new();
    let found = with_answers(SCRIPT, |operation| {
        if let Operation::Space(text) = operation {
            let name = format!("script-{}", indices.len());
            indices.push(make(&text.parse().unwrap(), &name));
            return None;
        }
        let index = indices.last().expect("the script begins with a space");
        Some(answer(index, operation).unwrap_or_else(refused))
    });
    assert_same(&found, SCRIPT);
    // The server takes every write.
    for index in indices {
        assert_eq!(index.close(MAX_WAIT), []);
    }
}

fn answer(index: &Index, operation: Operation) -> Result<Answer, Error> {
    Ok(match operation {
        Operation::Space(_) => unreachable!("replayed above"),
        Operation::Insert(state) => Answer::Number(index.insert(state)?),
        Operation::InsertWith { id, tag, state } => {
            let options = InsertOptions::new().tag(tag);
            let options = id.map_or(options, |id| options.id(id));
            Answer::Number(index.insert_with(state, options)?.id)
        }
        Operation::InsertMany(states) => Answer::Ids(index.insert_many(states)?),
        Operation::Replace { id, state } => Answer::Done(index.replace(id, state)?),
        Operation::Remove { id } => Answer::Done(index.remove(id)?),
        Operation::SetTag { id, tag } => Answer::Done(index.set_tag(id, tag)?),
        Operation::Get { id } => {
            let point = index.get(id)?;
            Answer::Point(point.map(|point| (point.tag, point.state)))
        }
        Operation::Len => Answer::Number(index.len()? as u64),
        Operation::Nearest(state) => {
            let nearest: Option<Neighbor> = index.nearest(state)?;
            Answer::Neighbors(nearest.into_iter().collect())
        }
        Operation::NearestK { k, state } => Answer::Neighbors(index.nearest_k(state, k)?),
        Operation::NearestR { radius, state } => Answer::Neighbors(index.nearest_r(state, radius)?),
        Operation::Search {
            k,
            radius,
            tag_mask,
            tag_value,
            epsilon,
            state,
        } => {
            let search = k.map_or(Search::within(radius), |k| Search::k(k).radius(radius));
            let search = search.tag(tag_mask, tag_value).epsilon(epsilon);
            Answer::Neighbors(index.search(state, &search)?.neighbors)
        }
    })
}

fn refused(error: Error) -> Answer {
    let code = match error.code() {
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::AlreadyExists => "ALREADY_EXISTS",
        other => panic!("{other:?}: {error}"),
    };
    let message = error.to_string();
    Answer::Refused { code, message }
}

/// Compares two scripts line by line, so that a failure names the line.
#[track_caller]
fn assert_same(found: &str, expected: &str) {
    let lines = found.lines().zip(expected.lines()).enumerate();
    for (at, (found, expected)) in lines {
        assert_eq!(found, expected, "line {}", at + 1);
    }
    assert_eq!(found.lines().count(), expected.lines().count());
}
