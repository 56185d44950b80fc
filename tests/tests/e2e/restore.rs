//! A restore whose server or client is killed leaves nothing behind; an acknowledged one survives a kill unchanged.

use std::{
    io::Write,
    process::{Command, Stdio},
};

use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use wayfold::Client;
use wayfold_index::Space;
use wayfold_proto::{
    snapshot::FileWriter,
    v1::{
        InsertRequest, ListIndexesRequest, OnConflict, RemoveRequest, RestoreIndexRequest,
        SnapshotIndexRequest, SnapshotPart, UpdateRequest,
    },
};
use wayfold_tests::{Content, ServerProcess, Signal, States, Stubs, row_states, server};

pub(crate) const ROWS: u64 = 20_000;

/// An index with a history: moved, removed and tagged points, payloads, and ids that were used and freed.
pub(crate) async fn lived_in(stubs: &mut Stubs, name: &str, seed: u64) {
    stubs.create(name, "R3*SO3:0.15").await;
    let mut states = States::new(Space::se3(), seed);
    for first in (0..ROWS).step_by(5_000) {
        let ids = first..first + 5_000;
        let insert = InsertRequest {
            index_name: name.into(),
            states: Some(row_states(&states.rows(5_000), 7)),
            tags: ids.clone().map(|id| id % 5).collect(),
            payloads: ids.clone().map(|id| format!("{id:x}").into()).collect(),
            ids: ids.map(|id| id * 2).collect(),
            ..Default::default()
        };
        stubs.insert(insert).await;
    }
    let moved = InsertRequest {
        index_name: name.into(),
        states: Some(row_states(&states.rows(1_000), 7)),
        ids: (0..1_000).map(|id| id * 20).collect(),
        on_conflict: OnConflict::Replace.into(),
        ..Default::default()
    };
    stubs.insert(moved).await;
    let removed = RemoveRequest {
        index_name: name.into(),
        ids: (ROWS..2 * ROWS).filter(|id| id % 6 == 0).collect(),
        ..Default::default()
    };
    stubs.points.remove(removed).await.unwrap();
    let tagged = UpdateRequest {
        index_name: name.into(),
        ids: (0..500).map(|id| id * 14).collect(),
        tags: vec![u64::MAX],
        ..Default::default()
    };
    stubs.points.update(tagged).await.unwrap();
}

pub(crate) async fn snapshot(stubs: &mut Stubs) -> Vec<SnapshotPart> {
    let request = SnapshotIndexRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    let answers = stubs.indexes.snapshot_index(request).await;
    let mut answers = answers.unwrap().into_inner();
    let mut parts = Vec::new();
    while let Some(answer) = answers.message().await.unwrap() {
        parts.push(answer.part.unwrap());
    }
    parts
}

/// The names of the indices.
async fn names(server: &ServerProcess) -> Vec<String> {
    let stubs = &mut Stubs::connect(server.uri()).await.indexes;
    let listed = stubs.list_indexes(ListIndexesRequest::default()).await;
    let indexes = listed.unwrap().into_inner().indexes;
    indexes.into_iter().map(|index| index.name).collect()
}

async fn content(stubs: &Stubs) -> Content {
    let content = Content::read(stubs, "arm").await.unwrap();
    let uid = String::new();
    Content { uid, ..content }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restore_that_is_cut_anywhere_leaves_nothing_and_one_that_ended_survives() {
    let source = server!();
    let mut original = Stubs::connect(source.uri()).await;
    lived_in(&mut original, "arm", 4).await;
    let parts = snapshot(&mut original).await;
    assert!(parts.len() > 4, "{} parts", parts.len());
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().to_str().unwrap();
    let mut target = server!("--data", data);
    let restoring = async |target: &ServerProcess| {
        let mut stubs = Stubs::connect(target.uri()).await;
        let (sender, receiver) = mpsc::channel(1);
        let requests = ReceiverStream::new(receiver);
        let call = tokio::spawn(async move { stubs.indexes.restore_index(requests).await });
        (sender, call)
    };
    let send = async |sender: &mpsc::Sender<RestoreIndexRequest>, parts: &[SnapshotPart]| {
        for part in parts {
            let (name, part) = ("arm".into(), Some(part.clone()));
            let message = RestoreIndexRequest { name, part };
            sender.send(message).await.unwrap();
        }
    };
    // The server is killed after it received `sent` parts.
    for sent in 1..=parts.len() {
        let (sender, call) = restoring(&target).await;
        send(&sender, &parts[..sent]).await;
        target.stop(Signal::Kill);
        assert!(call.await.unwrap().is_err());
        drop(sender);
        target = server!("--data", data);
        assert!(names(&target).await.is_empty(), "after {sent} parts");
    }

    // The client is killed when it has read half of the file.
    let mut file = FileWriter::new(Vec::new());
    for part in &parts {
        file.write(part).unwrap();
    }
    let bytes = file.finish().unwrap();
    let mut client = Command::new(env!("CARGO_BIN_EXE_cli-process"))
        .args(["--server", target.uri(), "restore", "arm", "-"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let mut stdin = client.stdin.take().unwrap();
    stdin.write_all(&bytes[..bytes.len() / 2]).unwrap();
    client.kill().unwrap();
    client.wait().unwrap();
    assert!(names(&target).await.is_empty());

    let (sender, call) = restoring(&target).await;
    send(&sender, &parts).await;
    drop(sender);
    call.await.unwrap().unwrap();
    // Only the acknowledged restore is stored, and it is complete.
    target.stop(Signal::Kill);
    let target = server!("--data", data);
    assert_eq!(names(&target).await, ["arm"]);
    let copy = Stubs::connect(target.uri()).await;
    assert_eq!(content(&copy).await, content(&original).await);
    let client = Client::connect(target.uri()).await.unwrap();
    let verified = client.index("arm").await.unwrap().verify().await.unwrap();
    assert!(verified.agrees(), "{:?}", verified.first_disagreements);
}
