//! The answers that a client process received, written down for a test to check afterwards.
//!
//! A ledger is a file of entries; an entry is a byte for its kind, the request and the response, both as protobuf with
//! their length before them. So every bit of a distance is kept.

use std::{fs, io::Write, path::Path};

use prost::{DecodeError, Message, bytes::Buf};
use wayfold_proto::v1::{
    InsertRequest, InsertResponse, KnnRequest, KnnResponse, OpenSessionRequest,
    OpenSessionResponse, QueryRequest, QueryResponse, RemoveRequest, RemoveResponse, UpdateRequest,
    UpdateResponse, WriteRequest, WriteResponse,
};

use crate::number;

/// An answered call.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry {
    /// An insert.
    Insert(InsertRequest, InsertResponse),
    /// A removal.
    Remove(RemoveRequest, RemoveResponse),
    /// An update of tags.
    Update(UpdateRequest, UpdateResponse),
    /// The opening of a writer session.
    OpenSession(OpenSessionRequest, OpenSessionResponse),
    /// A batch of a session.
    Write(WriteRequest, WriteResponse),
    /// A search for the nearest.
    Knn(KnnRequest, KnnResponse),
    /// A search for all within a radius.
    Query(QueryRequest, QueryResponse),
}

impl Entry {
    /// The revision in the answer.
    pub fn revision(&self) -> u64 {
        match self {
            Entry::Insert(_, response) => number(&response.revision),
            Entry::Remove(_, response) => number(&response.revision),
            Entry::Update(_, response) => number(&response.revision),
            Entry::OpenSession(_, response) => number(&response.revision),
            Entry::Write(_, response) => number(&response.revision),
            Entry::Knn(_, response) => number(&response.revision),
            Entry::Query(_, response) => number(&response.revision),
        }
    }

    /// True if the call made its revision, according to the answer.
    pub fn changed(&self) -> bool {
        use wayfold_proto::v1::Outcome::{Inserted, Replaced};
        match self {
            Entry::Insert(_, response) => response
                .outcomes()
                .any(|outcome| matches!(outcome, Inserted | Replaced)),
            Entry::Remove(_, response) => response.removed_count > 0,
            Entry::Update(_, response) => response.updated_count > 0,
            Entry::OpenSession(..) | Entry::Write(..) => true,
            Entry::Knn(..) | Entry::Query(..) => false,
        }
    }

    fn encode(&self) -> Vec<u8> {
        let (kind, request, response) = match self {
            Entry::Insert(a, b) => (0, encoded(a), encoded(b)),
            Entry::Remove(a, b) => (1, encoded(a), encoded(b)),
            Entry::Knn(a, b) => (2, encoded(a), encoded(b)),
            Entry::Query(a, b) => (3, encoded(a), encoded(b)),
            Entry::OpenSession(a, b) => (4, encoded(a), encoded(b)),
            Entry::Write(a, b) => (5, encoded(a), encoded(b)),
            Entry::Update(a, b) => (6, encoded(a), encoded(b)),
        };
        [vec![kind], request, response].concat()
    }

    fn decode(ledger: &mut &[u8]) -> Result<Self, DecodeError> {
        let kind = ledger.get_u8();
        Ok(match kind {
            0 => Entry::Insert(decoded(ledger)?, decoded(ledger)?),
            1 => Entry::Remove(decoded(ledger)?, decoded(ledger)?),
            2 => Entry::Knn(decoded(ledger)?, decoded(ledger)?),
            3 => Entry::Query(decoded(ledger)?, decoded(ledger)?),
            4 => Entry::OpenSession(decoded(ledger)?, decoded(ledger)?),
            5 => Entry::Write(decoded(ledger)?, decoded(ledger)?),
            6 => Entry::Update(decoded(ledger)?, decoded(ledger)?),
            other => panic!("an entry of kind {other}"),
        })
    }
}

fn encoded(message: &impl Message) -> Vec<u8> {
    message.encode_length_delimited_to_vec()
}

fn decoded<M: Message + Default>(ledger: &mut &[u8]) -> Result<M, DecodeError> {
    M::decode_length_delimited(ledger)
}

/// Writes a ledger.
///
/// # Panics
/// If the file cannot be written.
pub fn write(path: &Path, entries: &[Entry]) {
    let mut file = fs::File::create(path).expect("a ledger file");
    for entry in entries {
        file.write_all(&entry.encode()).expect("a writable ledger");
    }
}

/// Reads a ledger.
///
/// # Panics
/// If it is not one.
pub fn read(path: &Path) -> Vec<Entry> {
    let bytes = fs::read(path).expect("a ledger file");
    let mut rest = bytes.as_slice();
    let mut entries = Vec::new();
    while !rest.is_empty() {
        entries.push(Entry::decode(&mut rest).expect("an entry"));
    }
    entries
}
