//! Indices that the server cannot read.

use std::{fs, path::Path, sync::Arc};

use serde_json::json;
use tempfile::TempDir;
use wayfold::Code;
use wayfold_proto::v1;
use wayfold_server::{
    log::{Durability, FjallLog},
    registry::{Registry, RegistryOptions},
    service::{Call, Limits, Service},
};

use crate::{
    journal_end::newest_journal,
    process::{closed_pipe, command},
    server::Server,
};

/// Stores the indices `arm`, `leg` and `rail` in a directory, and then loses the last mutation, which was of `leg`.
/// Returns the uids of all three.
fn lose_a_mutation(directory: &Path) -> Vec<String> {
    let log = FjallLog::open(directory, Durability::Fsync).unwrap();
    let registry = Registry::new(Arc::new(log), RegistryOptions::default());
    let service = Service::new(registry, Limits::default());
    service.set_ready();
    let call = Call::default();
    // The end of the runtime ends all running tasks, and closes the store.
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let uids = runtime.block_on(async move {
        let mut uids = Vec::new();
        for name in ["arm", "leg", "rail"] {
            let request = v1::CreateIndexRequest {
                name: name.into(),
                space_form: Some(v1::create_index_request::SpaceForm::SpaceText("R1".into())),
                ..Default::default()
            };
            let created = service.create_index(&call, request).await.unwrap();
            uids.push(created.index.unwrap().revision.unwrap().uid);
        }
        let insert = v1::InsertRequest {
            index_name: "leg".into(),
            states: Some(v1::States {
                row_count: 1,
                coordinates: vec![0.5],
            }),
            ..Default::default()
        };
        service.insert(&call, insert).await.unwrap();
        uids
    });
    drop(runtime);

    let (journal, used) = newest_journal(&directory.join("store"));
    let file = fs::File::options().write(true).open(journal).unwrap();
    file.set_len(used - 1).unwrap();
    uids
}

/// The data directory of these indices, a server of it, and the uids. The directory comes first, so that it is dropped last.
async fn damaged_server() -> (TempDir, Server, Vec<String>) {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().to_owned();
    let lose = tokio::task::spawn_blocking(move || lose_a_mutation(&path));
    let uids = lose.await.unwrap();
    let server = Server::with(|config| config.data.dir = directory.path().to_str().unwrap().into());
    (directory, server, uids)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_leaves_hides_no_damage() {
    let (_directory, server, _) = damaged_server().await;
    // The list is longer than the buffer of the output.
    let circles: Vec<String> = (1..=120).map(|weight| format!("SO2:{weight}")).collect();
    for index in 0..16 {
        let name = format!("wide-{index}");
        server.index(&name, &circles.join("*")).await;
    }
    for format in ["text", "json"] {
        let mut list = command(&server.uri, &["list", "--output", format]);
        assert!(list.output().unwrap().stdout.len() > 8192);
        let output = list.stdout(closed_pipe()).output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{output:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_index_that_cannot_be_read_is_listed_and_can_be_deleted() {
    let (_directory, server, uids) = damaged_server().await;
    let client = server.client().await;

    let list = client.list_indexes().await.unwrap();
    let names: Vec<&str> = list.indexes.iter().map(|index| &*index.name).collect();
    assert_eq!(names, ["arm", "rail"]);
    let [damaged] = &list.damaged[..] else {
        panic!("{list:?}");
    };
    assert_eq!((&damaged.name, &damaged.uid), (&"leg".into(), &uids[1]));
    let refused = client.index_info("leg").await.unwrap_err();
    assert_eq!(refused.code(), Code::DataLoss);
    assert_eq!(refused.to_string(), damaged.error.to_string());
    assert_eq!(damaged.error.reason, "DATA_LOSS");

    let listed = server.json(&["list"]);
    let error: serde_json::Value = serde_json::from_str(&listed.stderr).unwrap();
    assert_eq!(error["error"]["reason"], "DAMAGED_INDEX");
    let lines = listed.lines_and(1);
    assert_eq!(lines.len(), 3);
    let message = &damaged.error.message;
    assert!(
        message.contains("revision 1 was stored and gone"),
        "{message}"
    );
    let error = json!({"code": "DATA_LOSS", "reason": "DATA_LOSS", "message": message});
    let expected = json!({"name": "leg", "uid": uids[1], "error": error});
    assert_eq!(lines[2], expected);
    let table = server.run(&["list"]);
    assert_eq!(table.status, Some(1));
    let problem = &table.stderr;
    assert!(problem.starts_with("error: 1 of 3 indices"), "{problem}");
    let rows: Vec<&str> = table.stdout.lines().collect();
    assert_eq!(
        rows[..3].concat(),
        "NAME  POINTS  REVISION  SPACEarm        0         0  R1rail       0         0  R1"
    );
    assert_eq!(
        rows[3..],
        [format!("leg is damaged: {message} (DATA_LOSS)")]
    );

    let deleted = server.json(&["delete", "leg"]).line();
    assert_eq!(deleted["uid"], uids[1]);
    let gone = client.delete_index("leg").await.unwrap_err();
    assert_eq!(gone.code(), Code::NotFound);
    assert_eq!(client.list_indexes().await.unwrap().damaged, []);
    for name in ["arm", "rail"] {
        client.delete_index(name).await.unwrap();
    }
    let empty = server.run(&["list"]);
    assert!(empty.stdout.starts_with("no indices"));
    assert_eq!((empty.status, &*empty.stderr), (Some(0), ""));
}
