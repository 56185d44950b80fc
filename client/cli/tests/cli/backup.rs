//! `snapshot`, `restore` and `verify`: an index in a file, through a pipe and on two servers.

use std::{fs, os::unix::fs::PermissionsExt};

use serde_json::Value;
use wayfold::IndexHandle;

use crate::{
    poses::{SPACE, pose},
    process::{Run, run_alone, shell},
    server::Server,
};

/// More points than fit into a file of 64 KiB.
const ROWS: u64 = 3000;

/// Fills an index: moved, removed and tagged points, payloads, ids that were used and are free.
async fn live_in(arm: &IndexHandle) {
    arm.insert((0..ROWS).map(pose))
        .ids((0..ROWS).map(|id| id * 2).collect::<Vec<_>>())
        .tags((0..ROWS).map(|id| id % 5).collect::<Vec<_>>())
        .payloads((0..ROWS).map(|id| format!("{id:x}")))
        .await
        .unwrap();
    arm.insert((ROWS..ROWS + 200).map(pose))
        .ids((0..200).map(|id| id * 20).collect::<Vec<_>>())
        .replace()
        .await
        .unwrap();
    let removed = (ROWS..2 * ROWS).filter(|id| id % 6 == 0);
    arm.remove(removed.collect::<Vec<_>>()).await.unwrap();
    let tagged: Vec<u64> = (0..100).map(|id| id * 14).collect();
    arm.update(tagged).tags([u64::MAX]).await.unwrap();
}

/// A server whose index `arm` has a past, and a snapshot of that index in a file.
struct Source {
    server: Server,
    directory: tempfile::TempDir,
}

impl Source {
    async fn new() -> Source {
        let server = Server::start();
        live_in(&server.index("arm", SPACE).await).await;
        let directory = tempfile::tempdir().unwrap();
        let source = Source { server, directory };
        let written = source.server.json(&["snapshot", "arm", &source.file()]);
        let written = written.line();
        let info = source.server.json(&["info", "arm"]).line();
        assert_eq!(written["point_count"], info["point_count"]);
        assert_eq!(written["revision"], info["revision"]);
        let length = fs::metadata(source.file()).unwrap().len();
        assert_eq!(written["bytes"], length);
        source
    }

    fn file(&self) -> String {
        self.path("arm.snapshot")
    }

    fn path(&self, name: &str) -> String {
        let path = self.directory.path().join(name);
        path.to_str().unwrap().to_owned()
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

/// All columns of all points as text. A number in text is read back as the same bits.
fn content(server: &Server, name: &str) -> String {
    let all = "states,tags,revisions,payloads";
    let run = server.run(&["scan", name, "--include", all]);
    assert_eq!(run.status, Some(0), "{}", run.stderr);
    run.stdout
}

#[tokio::test(flavor = "multi_thread")]
async fn an_index_goes_to_another_server_by_a_file_and_to_another_name_by_a_pipe() {
    let (source, target) = (Source::new().await, Server::start());
    let restored = target.json(&["restore", "arm", &source.file()]).line();
    let original = source.server.json(&["info", "arm"]).line();
    let (ours, theirs) = (&restored["revision"], &original["revision"]);
    assert_eq!(ours["number"], theirs["number"]);
    assert_ne!(ours["uid"], theirs["uid"]);
    let expected = content(&source.server, "arm");
    assert_eq!(content(&target, "arm"), expected);

    let piped = shell(
        &source.server.uri,
        "\"$0\" snapshot arm - | \"$0\" restore copy -",
    );
    assert_eq!(piped.status, Some(0), "{}", piped.stderr);
    assert_eq!(content(&source.server, "copy"), expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn servers_are_verified_and_compared() {
    let (source, target) = (Source::new().await, Server::start());
    target.json(&["restore", "arm", &source.file()]).line();
    let verified = target.json(&["verify", "arm", "--queries", "50"]).line();
    assert_eq!(verified["agrees"], true);
    assert_eq!(verified["query_count"], 50);
    assert_eq!(verified["point_count"], verified["stored_point_count"]);

    let servers = ["--server", &source.server.uri, "--server", &target.uri];
    let both = |arguments: &[&str]| run_alone(&[&servers, arguments].concat());
    let original = source.server.client().await.index("arm").await.unwrap();
    let copy = target.client().await.index("arm").await.unwrap();
    let put = async |index: &IndexHandle, id: u64, number: u64| {
        let insert = index.insert([pose(number)]).ids([id]).replace();
        insert.await.unwrap();
    };
    // The contents are equal, although the revisions differ.
    put(&original, 7, 10_001).await;
    put(&original, 7, 10_002).await;
    put(&copy, 7, 10_002).await;
    let agreed = both(&["verify", "arm", "--output", "json"]).lines();
    assert_eq!(agreed[0]["content_hash"], agreed[1]["content_hash"]);
    let number = |line: &Value| line["revision"]["number"].clone();
    assert_ne!(number(&agreed[0]), number(&agreed[1]));
    assert_eq!(agreed[2]["same_content"], true);
    let agreed = both(&["verify", "arm"]);
    assert_eq!(agreed.status, Some(0), "{}", agreed.stderr);
    assert!(agreed.stdout.contains("same points"), "{}", agreed.stdout);

    let differ = |parts: &[&str]| -> Run {
        let run = both(&["verify", "arm"]);
        assert_eq!(run.status, Some(1), "{}", run.stderr);
        for part in parts {
            assert!(run.stderr.contains(part), "{part}: {}", run.stderr);
        }
        run
    };
    copy.update([7]).tags([1]).await.unwrap();
    let tagged = differ(&["content: "]);
    assert!(!tagged.stdout.contains("same points"), "{}", tagged.stdout);
    let message = &tagged.stderr;
    assert!(!message.contains("stored points: "), "{message}");
    put(&copy, 7, 10_003).await;
    put(&copy, 9, 10_004).await;
    differ(&["stored points: ", &source.server.uri, &target.uri]);
    target.json(&["delete", "arm"]).line();
    target.json(&["create", "arm", "--space", "R3"]).line();
    differ(&["space: R3*SO3:0.15 on"]);

    // No other verb takes two servers, wherever the options stand.
    both(&["info", "arm"]).error(2);
    run_alone(&[&servers[..2], &["verify", "arm"], &servers[2..]].concat()).error(2);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_damaged_file_is_named_with_its_damage_and_leaves_no_index() {
    let (source, target) = (Source::new().await, Server::start());
    let good = fs::read(source.file()).unwrap();
    let damaged = source.path("damaged.snapshot");
    let refused = |bytes: &[u8], words: &str| {
        fs::write(&damaged, bytes).unwrap();
        let run = target.run(&["restore", "arm", &damaged]);
        let message = run.error(3);
        assert!(message.contains(&damaged), "{message}");
        assert!(message.contains(words), "{words}: {message}");
        assert!(target.json(&["list"]).lines().is_empty());
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
    let parts = good.iter().position(|&byte| byte == b'\n').unwrap();
    refused(
        &[b"wayfold snapshot 7", &good[parts..]].concat(),
        "version 7",
    );

    let complains = |arguments: &[&str], words: &str| {
        let run = target.run(&[&["restore"], arguments].concat());
        assert!(run.error(3).contains(words), "{words}: {}", run.stderr);
    };
    complains(&["arm", &source.path("missing")], "missing: ");
    let file = source.file();
    target.json(&["restore", "arm", &file]).line();
    complains(&["arm", &file], "\"arm\" already");
    complains(&["Arm!", &file], "Arm!");
    assert_eq!(target.json(&["verify", "arm"]).line()["agrees"], true);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_has_its_name_once_it_is_whole() {
    let source = Source::new().await;
    let file = source.file();
    let before = fs::read(&file).unwrap();
    let complains = |arguments: &[&str], words: &str| {
        let run = source.server.run(&[&["snapshot"], arguments].concat());
        assert!(run.error(3).contains(words), "{words}: {}", run.stderr);
    };
    complains(&["arm", &file], "--force");
    complains(&["leg", &file, "--force"], "leg");
    let elsewhere = source.path("no-such-directory/arm.snapshot");
    complains(&["arm", &elsewhere], &elsewhere);
    let directory = source.directory.path().to_str().unwrap();
    complains(&["arm", directory, "--force"], "not a regular file");

    // No file may have more than 64 KiB, as on a disk that is full.
    for name in ["full.snapshot", "arm.snapshot"] {
        let script = format!(
            "trap '' XFSZ; ulimit -f 128; exec \"$0\" snapshot arm {} --force",
            source.path(name)
        );
        let full = shell(&source.server.uri, &script);
        assert!(full.error(3).contains(name), "{}", full.stderr);
    }
    let full = shell(&source.server.uri, "exec \"$0\" snapshot arm - > /dev/full");
    assert!(full.error(3).contains("standard output"), "{}", full.stderr);

    // No other file is left, and the earlier file is unchanged.
    assert_eq!(source.names(), ["arm.snapshot"]);
    assert_eq!(fs::read(&file).unwrap(), before);
    source.server.json(&["remove", "arm", "2"]).line();
    let private = fs::Permissions::from_mode(0o600);
    fs::set_permissions(&file, private.clone()).unwrap();
    let again = source.server.json(&["snapshot", "arm", &file, "--force"]);
    let mode = fs::metadata(&file).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, private.mode());
    let again = again.line();
    assert_ne!(fs::read(&file).unwrap(), before);
    let target = Server::start();
    let restored = target.json(&["restore", "leg", &file]).line();
    assert_eq!(restored["revision"]["number"], again["revision"]["number"]);
    assert_eq!(source.names(), ["arm.snapshot"]);
}
