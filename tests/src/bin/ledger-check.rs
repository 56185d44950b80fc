//! Compares the answers that planners received with brute force: `ledger-check URI INDEX LEDGER...`.
//!
//! The ledgers hold every mutation of the index, and no other client has changed it. The process fails if an answer is
//! wrong.

use std::{env, path::Path};

use wayfold_tests::{Content, Model, Stubs, ledger};

#[tokio::main(flavor = "current_thread")]
async fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [uri, index, ledgers @ ..] = arguments.as_slice() else {
        panic!("usage: ledger-check URI INDEX LEDGER...");
    };
    let mut stubs = Stubs::connect(uri).await;
    let space = stubs.describe(index).await.space_text;
    let mut model = Model::new(space.parse().expect("a space"));
    let read = ledgers.iter().map(|path| ledger::read(Path::new(path)));
    let mut entries: Vec<_> = read.flatten().collect();
    // At each revision the mutation comes first, because the other answers saw its result.
    entries.sort_by_key(|entry| (entry.revision(), !entry.changed()));
    for entry in &entries {
        model.check(entry);
    }
    let content = Content::read(&stubs, index).await;
    model.check_content(&content.expect("a scan"));
    let (answers, revision) = (entries.len(), model.revision());
    println!("{answers} answers equal brute force, up to revision {revision}");
}
