//! The pages for operators: what they count is what clients counted.

use std::{collections::BTreeMap, fs, io::Write};

use futures_util::stream;
use tonic::{Code, Request, client::Grpc, codegen::http::uri::PathAndQuery, transport::Endpoint};
use tonic_prost::ProstCodec;
use wayfold_proto::v1;
use wayfold_tests::{
    Process, Refusal, ServerProcess, Signal, Stubs, insert_request, knn_request, measuring, page,
    server,
};

const KNNS: u64 = 37;
const INSERTS: u64 = 5;
/// The inserts, and the record that opens a session.
const REVISIONS: u64 = INSERTS + 1;
const MISSING: u64 = 3;
const QUERIES: u64 = 4;
const MISSED: u64 = 2;

/// The figures of `/metrics` by name and labels.
pub(crate) fn figures(address: &str) -> BTreeMap<String, f64> {
    let (status, text) = page(address, "/metrics", "");
    assert_eq!(status, 200, "{text}");
    assert!(text.ends_with("# EOF\n"), "{text}");
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let figures = lines.map(|line| {
        let (name, figure) = line.rsplit_once(' ').unwrap();
        (name.to_owned(), figure.parse().unwrap())
    });
    figures.collect()
}

pub(crate) fn calls(face: &str, verb: &str, index: &str, outcome: &str) -> String {
    format!(
        "wayfold_call_seconds_count{{face=\"{face}\",verb=\"{verb}\",index=\"{index}\",outcome=\"{outcome}\"}}"
    )
}

fn server(arguments: &[&str]) -> ServerProcess {
    let program = env!("CARGO_BIN_EXE_server-process");
    ServerProcess::start(program, &[&["--http", "127.0.0.1:0"], arguments].concat())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_counts_are_those_of_the_clients() {
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().join("data");
    let data = data.to_str().unwrap();
    let mut server = server(&["--zenoh", "tcp/127.0.0.1:0", "--data", data]);
    let zenoh = server.zenoh();
    let address = server.pages();
    let mut stubs = Stubs::connect(server.uri()).await;
    let uid = stubs.create("arm", "R1").await.revision.unwrap().uid;
    let knn = |index: &str| knn_request(index, &[0.0], 1, 1);
    let session = v1::OpenSessionRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    stubs.points.open_session(session).await.unwrap();
    for _ in 0..INSERTS {
        stubs.insert(insert_request("arm", &[1.0, 2.0], 1)).await;
    }
    for _ in 0..KNNS {
        stubs.points.knn(knn("arm")).await.unwrap();
    }
    for number in 0..MISSING {
        let status = stubs.points.knn(knn(&format!("missing-{number}"))).await;
        assert_eq!(status.unwrap_err().code(), Code::NotFound);
    }
    let session = measuring::connect(&zenoh).await;
    for _ in 0..QUERIES {
        let answers = session.get("wayfold/v1/arm/info").await.unwrap();
        answers.recv_async().await.unwrap().into_result().unwrap();
    }

    // A subscriber that missed the last mutations, and one that has them all.
    for after in [REVISIONS - MISSED, REVISIONS] {
        let log = format!("wayfold/v1/arm/log?from={after};uid={uid}");
        let answers = session.get(log).await.unwrap();
        answers.recv_async().await.unwrap().into_result().unwrap();
    }

    let watch = v1::WatchRequest {
        index_name: "arm".into(),
        ..Default::default()
    };
    let mut watching = stubs.points.watch(watch).await.unwrap().into_inner();
    watching.message().await.unwrap().unwrap();

    let figures = figures(&address);
    for (name, expected) in [
        (calls("grpc", "knn", "arm", "OK"), KNNS),
        (calls("grpc", "insert", "arm", "OK"), INSERTS),
        (calls("grpc", "create", "", "OK"), 1),
        // Names that a stranger makes up make no series of their own.
        (calls("grpc", "knn", "", "NOT_FOUND"), MISSING),
        (calls("zenoh", "info", "arm", "OK"), QUERIES),
        (calls("zenoh", "log", "arm", "OK"), 2),
        ("wayfold_index_points{index=\"arm\"}".into(), 2 * INSERTS),
        ("wayfold_index_revision{index=\"arm\"}".into(), REVISIONS),
        ("wayfold_index_sessions{index=\"arm\"}".into(), 1),
        ("wayfold_index_batches{index=\"arm\"}".into(), 0),
        ("wayfold_index_unmerged_points{index=\"arm\"}".into(), 0),
        ("wayfold_index_merge_lag_seconds{index=\"arm\"}".into(), 0),
        ("wayfold_merges{state=\"running\"}".into(), 0),
        ("wayfold_zenoh_links".into(), 1),
        ("wayfold_index_subscribers{index=\"arm\"}".into(), 1),
        ("wayfold_index_subscriber_lag{index=\"arm\"}".into(), 0),
        (
            "wayfold_index_window_records{index=\"arm\"}".into(),
            REVISIONS,
        ),
        (
            "wayfold_index_missed_records_total{index=\"arm\"}".into(),
            MISSED,
        ),
        ("wayfold_indices{state=\"served\"}".into(), 1),
        (
            "wayfold_refused_calls_total{reason=\"OVERLOADED\"}".into(),
            0,
        ),
        ("wayfold_ready{state=\"reading\"}".into(), 1),
        ("wayfold_ready{state=\"writing\"}".into(), 1),
    ] {
        assert_eq!(
            figures.get(&name),
            Some(&(expected as f64)),
            "{name} in {figures:#?}"
        );
    }
    let all: f64 = figures
        .iter()
        .filter(|(name, _)| name.starts_with("wayfold_call_seconds_count"))
        .map(|(_, count)| count)
        .sum();
    let made = KNNS + INSERTS + MISSING + QUERIES + 4;
    assert_eq!(all, made as f64, "{figures:#?}");
    let queued = figures["wayfold_queue_seconds_count{face=\"grpc\"}"];
    assert_eq!(queued, (made - QUERIES - 2) as f64);
    // The mutations were acknowledged one after the other, so each has its own sync.
    let syncs = figures["wayfold_log_sync_seconds_count"];
    assert!(syncs >= INSERTS as f64, "{syncs}");
    assert!(figures["wayfold_resource_bytes{resource=\"memory\",of=\"used\"}"] > 1e6);
    for part in ["trees", "recent_records", "store"] {
        let bytes = figures[&format!("wayfold_memory_bytes{{part=\"{part}\"}}")];
        assert!(bytes > 0.0, "{part}");
    }
    // No operation has an id, and no index has a quota.
    for part in ["operations", "payload_sizes"] {
        let bytes = figures[&format!("wayfold_memory_bytes{{part=\"{part}\"}}")];
        assert_eq!(bytes, 0.0, "{part}");
    }
    for part in ["journal", "tables", "other"] {
        let bytes = figures[&format!("wayfold_disk_bytes{{part=\"{part}\"}}")];
        assert!(bytes > 0.0, "{part}");
    }
}

#[tokio::test]
async fn requests_that_do_not_arrive_in_time_are_counted() {
    let mut server = server!("--http", "127.0.0.1:0"; ("WAYFOLD_GRPC__RECEIVE_TIMEOUT_MS", "1"));
    let address = server.pages();
    let channel = Endpoint::from_shared(server.uri().to_owned()).unwrap();
    let mut grpc = Grpc::new(channel.connect().await.unwrap());
    grpc.ready().await.unwrap();
    let codec = ProstCodec::<v1::InsertRequest, v1::InsertResponse>::default();
    let path = PathAndQuery::from_static("/wayfold.v1.PointService/Insert");
    let never = Request::new(stream::pending());
    let refused = grpc.client_streaming(never, path, codec).await.unwrap_err();
    assert_eq!(Refusal::of(&refused).reason, "TOO_SLOW", "{refused:?}");
    let mut stubs = Stubs::connect(server.uri()).await;
    let restored = stubs.indexes.restore_index(stream::pending()).await;
    let refused = restored.unwrap_err();
    assert_eq!(Refusal::of(&refused).reason, "TOO_SLOW", "{refused:?}");
    let counted = "wayfold_refused_calls_total{reason=\"TOO_SLOW\"}";
    assert_eq!(figures(&address)[counted], 2.0);
}

/// 100 indices have labels; an index that was deleted gives its label to a new one.
#[tokio::test]
async fn deleted_indices_make_room_for_the_labels_of_others() {
    const LABELS: usize = 100;
    let mut server = server(&["--zenoh", "off", "--data", "memory"]);
    let address = server.pages();
    let mut stubs = Stubs::connect(server.uri()).await;
    let old: Vec<_> = (0..2 * LABELS).map(|it| format!("old-{it}")).collect();
    for name in old.iter().map(String::as_str).chain(["new"]) {
        stubs.create(name, "R1").await;
        let index_name = name.to_owned();
        let request = v1::GetIndexRequest { index_name };
        stubs.indexes.get_index(request).await.unwrap();
        if name != "new" {
            let request = v1::DeleteIndexRequest {
                index_name: name.into(),
                ..Default::default()
            };
            stubs.indexes.delete_index(request).await.unwrap();
        }
    }
    let figures = figures(&address);
    let count = |index: &str| figures.get(&calls("grpc", "info", index, "OK")).copied();
    assert_eq!((count("new"), count(&old[0])), (Some(1.0), None));
    let shown = old.iter().filter(|name| count(name).is_some());
    assert!(shown.count() < LABELS, "{figures:#?}");
}

#[test]
fn probes_answer_everyone_and_metrics_those_with_an_identity() {
    let file = tempfile::NamedTempFile::new().unwrap();
    // The SHA-256 of "password".
    let digest = "5e884898da28047151d0e56f8dc6292773603d0d6aabbdd62a11ef721d1542d8";
    let of_cell = "39d02b42938b2b75d027ebeb25c9d1fd0b71b6e0453e217a2e85cedc7e4637b4";
    let of_nothing = "1785cfc3bc6ac7738e8b38cdccd1af12563c2b9070e07af336a1bf8c0f772b6a";
    let entry = format!(
        "[[identity]]\nname = \"prometheus\"\nrole = \"read\"\nindexes = []\nmetrics = true\n\
         token_sha256 = \"{digest}\"\n\
         [[identity]]\nname = \"cell\"\nrole = \"admin\"\nindexes = [\"cell-*\"]\ntoken_sha256 = \"{of_cell}\"\n\
         [[identity]]\nname = \"nothing\"\nrole = \"read\"\nindexes = []\ntoken_sha256 = \"{of_nothing}\"\n"
    );
    fs::write(file.path(), entry).unwrap();
    let mut settings = tempfile::NamedTempFile::new().unwrap();
    write!(settings, "[access]\nidentities = {:?}\n", file.path()).unwrap();
    let mut server = server(&["--config", settings.path().to_str().unwrap()]);
    let address = server.pages();
    for (path, header, status, part) in [
        ("/healthz", "", 200, "alive"),
        ("/readyz", "", 200, "reading, writing"),
        ("/metrics", "", 401, "neither a token"),
        (
            "/metrics",
            "Authorization: Bearer wrong\r\n",
            401,
            "no identity",
        ),
        (
            "/metrics",
            "Authorization: Bearer password\r\n",
            200,
            "wayfold_build",
        ),
        (
            "/metrics",
            "Authorization: Bearer cell\r\n",
            403,
            "name all indices",
        ),
        (
            "/metrics",
            "Authorization: Bearer nothing\r\n",
            403,
            "metrics = true",
        ),
        ("/", "", 200, "<title>Wayfold</title>"),
        ("/other", "", 404, ""),
    ] {
        let (found, body) = page(&address, path, header);
        assert_eq!(found, status, "{path} {body}");
        assert!(body.contains(part), "{path} {body}");
    }
    let (_, figures) = page(&address, "/metrics", "Authorization: Bearer password\r\n");
    for outcome in ["UNAUTHENTICATED", "PERMISSION_DENIED"] {
        let counted = format!("{} 2\n", calls("http", "metrics", "", outcome));
        assert!(figures.contains(&counted), "{counted} in {figures}");
    }
    let finished = server.stop(Signal::Terminate);
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
}

#[test]
fn an_address_that_is_taken_is_named() {
    let mut first = server(&[]);
    let taken = first.pages();
    let program = env!("CARGO_BIN_EXE_server-process");
    let arguments = [
        "--grpc",
        "127.0.0.1:0",
        "--data",
        "memory",
        "--http",
        &taken,
    ];
    let refused = Process::start(program, &arguments).finish();
    assert_eq!(refused.status.code(), Some(1), "{}", refused.stderr);
    assert!(refused.stderr.contains(&taken) && refused.stderr.contains("--http off"));
    // A server of the test's own, without pages, is not in its way.
    drop(server!());
}
