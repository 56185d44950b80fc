//! Backup and verification through the command line. An index restored elsewhere is the same to the bit. A restore of a
//! damaged file, or one that is cut or killed, leaves nothing.

use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use serde_json::Value;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use wayfold_index::Space;
use wayfold_proto::{
    snapshot::FileReader,
    v1::{
        Filter, InsertRequest, KnnRequest, OnConflict, RemoveRequest, RestoreIndexRequest,
        UpdateRequest, knn_request::Count,
    },
};
use wayfold_tests::{
    Content, Finished, INCLUDE_ALL, Process, ServerProcess, Signal, States, Stubs, bits, revision,
    row_states, server,
};

const CLI: &str = env!("CARGO_BIN_EXE_cli-process");
const ROWS: u64 = 20_000;

fn cli(server: &ServerProcess, arguments: &[&str]) -> Finished {
    let arguments = [&["--server", server.uri()], arguments].concat();
    Process::start(CLI, &arguments).finish()
}

/// The JSON that a successful command prints.
fn told(server: &ServerProcess, arguments: &[&str]) -> Value {
    let finished = cli(server, &[arguments, &["--output", "json"]].concat());
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
    assert_eq!(finished.stderr, "", "a pipe has no progress bar");
    assert_eq!(finished.stdout.len(), 1, "{arguments:?}");
    serde_json::from_str(&finished.stdout[0]).unwrap()
}

/// The complaint of a command that fails.
fn complaint(finished: Finished) -> String {
    complaint_with(3, finished)
}

/// The complaint of a command that ends with this exit status.
fn complaint_with(status: i32, finished: Finished) -> String {
    assert_eq!(finished.status.code(), Some(status), "{}", finished.stderr);
    finished.stderr
}

/// An index with a past: moved, removed and tagged points, payloads, ids that were used and are free.
async fn lived_in(stubs: &mut Stubs, name: &str, seed: u64) {
    stubs.create(name, "R3*SO3:0.15").await;
    let mut states = States::new(Space::se3(), seed);
    for first in (0..ROWS).step_by(5_000) {
        let ids = first..first + 5_000;
        let insert = InsertRequest {
            index: name.into(),
            states: Some(row_states(&states.rows(5_000), 7)),
            tags: ids.clone().map(|id| id % 5).collect(),
            payloads: ids.clone().map(|id| format!("{id:x}").into()).collect(),
            ids: ids.map(|id| id * 2).collect(),
            ..Default::default()
        };
        stubs.insert(insert).await;
    }
    let moved = InsertRequest {
        index: name.into(),
        states: Some(row_states(&states.rows(1_000), 7)),
        ids: (0..1_000).map(|id| id * 20).collect(),
        on_conflict: OnConflict::Replace.into(),
        ..Default::default()
    };
    stubs.insert(moved).await;
    let removed = RemoveRequest {
        index: name.into(),
        ids: (ROWS..2 * ROWS).filter(|id| id % 6 == 0).collect(),
        ..Default::default()
    };
    stubs.points.remove(removed).await.unwrap();
    let tagged = UpdateRequest {
        index: name.into(),
        ids: (0..500).map(|id| id * 14).collect(),
        tags: vec![u64::MAX],
        ..Default::default()
    };
    stubs.points.update(tagged).await.unwrap();
}

/// All that is read of an index but its uid: the content, and answers to queries, to the bit.
async fn seen(stubs: &mut Stubs, name: &str) -> (Content, Vec<Vec<u64>>) {
    let mut content = Content::read(stubs, name).await.unwrap();
    let uid = std::mem::take(&mut content.uid);
    let mut answers = Vec::new();
    for since in 0..content.revision {
        let request = KnnRequest {
            index: name.into(),
            states: Some(row_states(&States::new(Space::se3(), 5).rows(20), 7)),
            count: Some(Count::K(20)),
            filter: Some(Filter {
                since_revision: revision(&uid, since),
                ..Default::default()
            }),
            include: Some(INCLUDE_ALL),
            min_revision: revision(&uid, content.revision),
            ..Default::default()
        };
        let answer = stubs.points.knn(request).await.unwrap().into_inner();
        let neighbors = answer.neighbors.unwrap();
        answers.push(neighbors.ids.clone());
        answers.push(bits(&neighbors.distances));
        answers.push(bits(&neighbors.states.unwrap().coordinates));
        answers.push(neighbors.tags);
        answers.push(neighbors.revisions);
    }
    (content, answers)
}

/// A server whose index `arm` has a past, and a snapshot of that index in a file.
struct Source {
    server: ServerProcess,
    stubs: Stubs,
    directory: tempfile::TempDir,
}

impl Source {
    async fn new(seed: u64) -> Self {
        let server = server!();
        let mut stubs = Stubs::connect(server.uri()).await;
        lived_in(&mut stubs, "arm", seed).await;
        let source = Self {
            server,
            stubs,
            directory: tempfile::tempdir().unwrap(),
        };
        let written = told(
            &source.server,
            &["snapshot", "arm", source.file().to_str().unwrap()],
        );
        let index = source.stubs.clone().describe("arm").await;
        assert_eq!(written["point_count"], index.point_count);
        let revision = index.revision.unwrap();
        assert_eq!(written["revision"]["number"], revision.number);
        assert_eq!(written["revision"]["uid"], revision.uid);
        let length = fs::metadata(source.file()).unwrap().len();
        assert_eq!(written["bytes"], length);
        source
    }

    fn file(&self) -> PathBuf {
        self.path("arm.snapshot")
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// The names in the directory.
    fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.directory.path()).unwrap();
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }
}

fn no_index(server: &ServerProcess) {
    let listed = cli(server, &["list", "--output", "json"]);
    assert_eq!(listed.stdout, Vec::<String>::new());
}

#[tokio::test]
async fn an_index_restored_elsewhere_is_the_same_and_goes_on_as_the_same() {
    let mut source = Source::new(1).await;
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().to_str().unwrap();
    let target = server!("--data", data);
    let mut stubs = Stubs::connect(target.uri()).await;
    let file = source.file();
    let file = file.to_str().unwrap();
    let restored = told(&target, &["restore", "arm", file]);
    let original = source.stubs.describe("arm").await;
    let revision = original.revision.unwrap();
    assert_eq!(restored["revision"]["number"], revision.number);
    assert_ne!(restored["revision"]["uid"], revision.uid);
    let expected = seen(&mut source.stubs, "arm").await;
    assert_eq!(seen(&mut stubs, "arm").await, expected);

    // Killed and started again too.
    target.stop(Signal::Kill);
    let target = server!("--data", data);
    let mut stubs = Stubs::connect(target.uri()).await;
    assert_eq!(seen(&mut stubs, "arm").await, expected);

    // Under another name, on the server it is from, through a pipe.
    let command = format!(
        "{CLI} --server {0} snapshot arm - | {CLI} --server {0} restore copy -",
        source.server.uri()
    );
    let piped = Process::start("sh", &["-c", &command]).finish();
    assert_eq!(piped.status.code(), Some(0), "{}", piped.stderr);
    assert_eq!(seen(&mut source.stubs, "copy").await, expected);

    // The next insert has the same ids, outcomes and revision.
    let insert = InsertRequest {
        index: "arm".into(),
        states: Some(row_states(&States::new(Space::se3(), 9).rows(100), 7)),
        ..Default::default()
    };
    let mut one = source.stubs.insert(insert.clone()).await;
    let mut other = stubs.insert(insert).await;
    for answer in [&mut one, &mut other] {
        answer.revision.as_mut().unwrap().uid.clear();
    }
    assert_eq!(one, other);
    let expected = seen(&mut source.stubs, "arm").await;
    assert_eq!(seen(&mut stubs, "arm").await, expected);
}

#[tokio::test]
async fn servers_are_verified_and_compared() {
    let source = Source::new(2).await;
    let target = server!();
    let mut stubs = Stubs::connect(target.uri()).await;
    let file = source.file();
    let file = file.to_str().unwrap();
    told(&target, &["restore", "arm", file]);
    let verified = told(&target, &["verify", "arm", "--queries", "50"]);
    assert_eq!(verified["agrees"], true);
    assert_eq!(verified["query_count"], 50);
    assert_eq!(verified["point_count"], verified["stored_point_count"]);

    let both = |arguments: &[&str]| {
        let servers = ["--server", source.server.uri(), "--server", target.uri()];
        Process::start(CLI, &[&servers, arguments].concat()).finish()
    };
    // The content is the same whatever became of it meanwhile.
    let moved = |seed| InsertRequest {
        index: "arm".into(),
        states: Some(row_states(&States::new(Space::se3(), seed).rows(1), 7)),
        ids: vec![7],
        on_conflict: OnConflict::Replace.into(),
        ..Default::default()
    };
    let mut original = source.stubs.clone();
    original.insert(moved(1)).await;
    original.insert(moved(2)).await;
    stubs.insert(moved(2)).await;
    let agreed = both(&["verify", "arm", "--output", "json"]);
    assert_eq!(agreed.status.code(), Some(0), "{}", agreed.stderr);
    let lines: Vec<Value> = agreed
        .stdout
        .iter()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    assert_eq!(lines[0]["content_hash"], lines[1]["content_hash"]);
    let number = |line: &Value| line["revision"]["number"].clone();
    assert_ne!(number(&lines[0]), number(&lines[1]));
    assert_eq!(lines[2]["same_content"], true);
    let agreed = both(&["verify", "arm"]);
    assert_eq!(agreed.status.code(), Some(0));
    assert!(
        agreed
            .stdout
            .iter()
            .any(|line| line.contains("same points"))
    );

    let tagged = UpdateRequest {
        index: "arm".into(),
        ids: vec![7],
        tags: vec![1],
        ..Default::default()
    };
    stubs.points.update(tagged).await.unwrap();
    let differ = both(&["verify", "arm"]);
    assert!(
        differ
            .stdout
            .iter()
            .all(|line| !line.contains("same points"))
    );
    let told = complaint_with(1, differ);
    assert!(told.contains("content: "), "{told}");
    assert!(!told.contains("stored points: "), "{told}");
    stubs.insert(moved(3)).await;
    stubs
        .insert(InsertRequest {
            ids: vec![9],
            ..moved(4)
        })
        .await;
    let told = complaint_with(1, both(&["verify", "arm"]));
    for part in ["stored points: ", source.server.uri(), target.uri()] {
        assert!(told.contains(part), "{told}");
    }
    stubs.delete("arm").await;
    stubs.create("arm", "R3").await;
    assert!(complaint_with(1, both(&["verify", "arm"])).contains("space: R3*SO3:0.15 on"));

    // No other verb takes two, and none is passed over, wherever they stand.
    assert_eq!(both(&["info", "arm"]).status.code(), Some(2));
    let apart = [
        "--server",
        source.server.uri(),
        "verify",
        "arm",
        "--server",
        target.uri(),
    ];
    let apart = Process::start(CLI, &apart).finish();
    assert_eq!(apart.status.code(), Some(2), "{:?}", apart.stdout);
}

#[tokio::test]
async fn what_is_damaged_is_refused_where_it_is_damaged_and_leaves_nothing() {
    let source = Source::new(3).await;
    let good = fs::read(source.file()).unwrap();
    let target = server!();
    let damaged = source.path("damaged.snapshot");
    let damaged = damaged.to_str().unwrap();
    let refused = |bytes: &[u8], words: &str| {
        fs::write(damaged, bytes).unwrap();
        let told = complaint(cli(&target, &["restore", "arm", damaged]));
        assert!(told.contains(damaged), "{told}");
        assert!(told.contains(words), "{words}: {told}");
        no_index(&target);
    };
    for share in 1..8 {
        let mut flipped = good.clone();
        flipped[good.len() / 8 * share] ^= 1;
        refused(&flipped, "part ");
        refused(&good[..good.len() / 8 * share], "cut short");
    }
    refused(&good[..good.len() - 1], "cut short");
    refused(&[&good[..], b"\n"].concat(), "follows the trailer");
    refused(&good[..10], "not a snapshot");
    refused(b"id,x,y\n1,2,3\n", "not a snapshot");
    refused(b"", "not a snapshot");
    let newer = good
        .iter()
        .map(|&byte| if byte == b'1' { b'7' } else { byte });
    refused(&newer.take(1000).collect::<Vec<_>>(), "version 7");
    let missing = source.path("missing");
    let missing = complaint(cli(&target, &["restore", "arm", missing.to_str().unwrap()]));
    assert!(missing.contains("missing: "), "{missing}");

    let file = source.file();
    let file = file.to_str().unwrap();
    told(&target, &["restore", "arm", file]);
    let taken = complaint(cli(&target, &["restore", "arm", file]));
    assert!(taken.contains("\"arm\" already"), "{taken}");
    let named = complaint(cli(&target, &["restore", "Arm!", file]));
    assert!(named.contains("Arm!"), "{named}");
    assert_eq!(told(&target, &["verify", "arm"])["agrees"], true);
}

/// The parts of a file.
fn parts(file: &Path) -> Vec<wayfold_proto::v1::SnapshotPart> {
    let mut reader = FileReader::new(fs::File::open(file).unwrap()).unwrap();
    let mut parts = Vec::new();
    while let Some((part, _)) = reader.next_part().unwrap() {
        parts.push(part);
    }
    parts
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restore_that_is_cut_anywhere_leaves_nothing() {
    let source = Source::new(4).await;
    let file = source.file();
    let parts = parts(&file);
    assert!(parts.len() > 4, "{} parts", parts.len());
    let directory = tempfile::tempdir().unwrap();
    let data = directory.path().to_str().unwrap();
    let mut target = server!("--data", data);
    // The server is killed after it was sent `sent` parts.
    for sent in 1..=parts.len() {
        let mut stubs = Stubs::connect(target.uri()).await;
        let (sender, receiver) = mpsc::channel(1);
        let call = tokio::spawn(async move {
            stubs
                .indexes
                .restore_index(ReceiverStream::new(receiver))
                .await
        });
        for part in &parts[..sent] {
            let (name, part) = ("arm".into(), Some(part.clone()));
            sender
                .send(RestoreIndexRequest { name, part })
                .await
                .unwrap();
        }
        target.stop(Signal::Kill);
        assert!(call.await.unwrap().is_err());
        drop(sender);
        target = server!("--data", data);
        no_index(&target);
    }

    // The client is killed when it has read half of the file.
    let bytes = fs::read(&file).unwrap();
    let mut client = Command::new(CLI)
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
    no_index(&target);

    told(&target, &["restore", "arm", file.to_str().unwrap()]);
    assert_eq!(told(&target, &["verify", "arm"])["agrees"], true);
    // And nothing of the others comes back.
    target.stop(Signal::Kill);
    let target = server!("--data", data);
    assert_eq!(cli(&target, &["list", "--output", "json"]).stdout.len(), 1);
}

#[tokio::test]
async fn a_file_has_its_name_once_it_is_whole() {
    let source = Source::new(5).await;
    let file = source.file();
    let file = file.to_str().unwrap();
    let before = fs::read(file).unwrap();
    let exists = complaint(cli(&source.server, &["snapshot", "arm", file]));
    assert!(exists.contains("--force"), "{exists}");
    let missing = complaint(cli(&source.server, &["snapshot", "leg", file, "--force"]));
    assert!(missing.contains("leg"), "{missing}");
    let elsewhere = source.path("no-such-directory/arm.snapshot");
    let elsewhere = elsewhere.to_str().unwrap();
    let unwritable = complaint(cli(&source.server, &["snapshot", "arm", elsewhere]));
    assert!(unwritable.contains(elsewhere), "{unwritable}");
    let directory = source.directory.path().to_str().unwrap();
    let no_file = complaint(cli(
        &source.server,
        &["snapshot", "arm", directory, "--force"],
    ));
    assert!(no_file.contains("not a regular file"), "{no_file}");

    // No file may have more than 64 KiB, as on a disk that is full.
    for name in ["full.snapshot", "arm.snapshot"] {
        let path = source.path(name);
        let command = format!(
            "trap '' XFSZ; ulimit -f 128; exec {CLI} --server {} snapshot arm {} --force",
            source.server.uri(),
            path.display()
        );
        let full = complaint(Process::start("sh", &["-c", &command]).finish());
        assert!(full.contains(name), "{full}");
    }
    let command = format!(
        "exec {CLI} --server {} snapshot arm - > /dev/full",
        source.server.uri()
    );
    let full = complaint(Process::start("sh", &["-c", &command]).finish());
    assert!(full.contains("standard output"), "{full}");

    // No other file is left, and the earlier file is unchanged.
    assert_eq!(source.names(), ["arm.snapshot"]);
    assert_eq!(fs::read(file).unwrap(), before);
    let mut stubs = source.stubs.clone();
    let removed = RemoveRequest {
        index: "arm".into(),
        ids: vec![0],
        ..Default::default()
    };
    stubs.points.remove(removed).await.unwrap();
    let again = told(&source.server, &["snapshot", "arm", file, "--force"]);
    assert_ne!(fs::read(file).unwrap(), before);
    let target = server!();
    let restored = told(&target, &["restore", "leg", file]);
    assert_eq!(restored["revision"]["number"], again["revision"]["number"]);
    assert_eq!(source.names(), ["arm.snapshot"]);
}
