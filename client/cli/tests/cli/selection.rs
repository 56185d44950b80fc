//! Tags, filters, columns and scaled numbers.

use serde_json::json;
use tonic::Status;
use wayfold::{Scaling, Space};

use crate::{
    fake::Fake,
    process::{command, run_alone},
    server::Server,
};

/// The index `line` with the points 0, 1 and 2 at 0, 10 and 20, tagged 0x11 by revision 1, and the point 3 at 30,
/// tagged 2 by revision 2.
fn tagged_line() -> Server {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    let insert = ["insert", "line", "-", "--tag"];
    server
        .json_with(&[&insert[..], &["0x11"]].concat(), "0\n10\n20\n")
        .line();
    server
        .json_with(&[&insert[..], &["2"]].concat(), "30\n")
        .line();
    server
}

#[test]
fn tags_are_set_by_insert_and_by_update() {
    let server = tagged_line();
    let tags = || -> Vec<u64> {
        let points = server.json(&["get", "line", "0", "1", "2", "3"]).lines();
        let tags = points.iter().map(|point| point["tag"].as_u64());
        tags.map(Option::unwrap).collect()
    };
    assert_eq!(tags(), [0x11, 0x11, 0x11, 2]);

    let updated = server.json(&["update", "line", "0", "3", "--tag", "5"]);
    assert_eq!(
        updated.line(),
        json!({"updated_count": 2, "unchanged_count": 0, "revision": server.revision("line", 3)})
    );
    assert_eq!(tags(), [5, 0x11, 0x11, 5]);

    let masked = server.run(&["update", "line", "0", "1", "--tag", "0x10/0xf0"]);
    assert_eq!(masked.stdout, "updated 1, unchanged 1; revision 4\n");
    assert_eq!(tags(), [0x15, 0x11, 0x11, 5]);

    // Point 0 has changed since revision 3, point 2 has not.
    let conflict = server.json(&["update", "line", "0", "--tag", "0", "--if-revision", "3"]);
    let error = conflict.json_error(3);
    assert_eq!(
        (&error["code"], &error["reason"], &error["ids"]),
        (
            &json!("FAILED_PRECONDITION"),
            &json!("REVISION_CONFLICT"),
            &json!([0])
        )
    );
    server
        .json(&["update", "line", "2", "--tag", "0", "--if-revision", "3"])
        .line();
    assert_eq!(tags(), [0x15, 0x11, 0, 5]);
}

#[test]
fn payloads_are_set_by_update_and_printed_if_included() {
    let server = tagged_line();
    let update = ["update", "line", "1", "2", "--payload", "caf\u{e9}\n"];
    assert_eq!(server.json(&update).line()["updated_count"], 2);
    // RFC 4648 of the bytes 63 61 66 c3 a9 0a.
    let get = ["get", "line", "1", "0", "--include", "payloads"];
    assert_eq!(
        server.json(&get).lines(),
        [
            json!({"id": 1, "payload": "Y2Fmw6kK"}),
            json!({"id": 0, "payload": ""})
        ]
    );
    let text = server.run(&get).stdout;
    assert_eq!(text, "1  payload \"caf\\xc3\\xa9\\n\"\n0  payload \"\"\n");
    assert_eq!(
        server.json(&["get", "line", "1"]).line().get("payload"),
        None
    );

    server
        .json(&["update", "line", "1", "--payload", ""])
        .line();
    assert_eq!(server.json(&get).lines()[0]["payload"], "");
}

#[test]
fn reads_are_limited_by_tag_and_revision() {
    let server = tagged_line();
    let found = |options: &[&str]| {
        let knn = ["knn", "line", "-k", "9", "--state", "21"];
        let query = ["query", "line", "--radius", "inf", "--state", "21"];
        let near = server.json(&[&knn[..], options].concat()).line()["ids"].take();
        let within = server.json(&[&query[..], options].concat()).line()["ids"].take();
        assert_eq!(near, within);
        let scan = [&["scan", "line"], options].concat();
        let mut scanned: Vec<_> = server
            .json(&scan)
            .lines()
            .iter()
            .map(|point| point["id"].as_u64().unwrap())
            .collect();
        scanned.sort_by_key(|id| (10 * id).abs_diff(21));
        assert_eq!(near, json!(scanned));
        scanned
    };
    assert_eq!(found(&[]), [2, 3, 1, 0]);
    assert_eq!(found(&["--tag", "0x11"]), [2, 1, 0]);
    assert_eq!(found(&["--tag", "17"]), [2, 1, 0]);
    assert!(found(&["--tag", "0x1"]).is_empty());
    assert_eq!(found(&["--tag", "0x1/0x1"]), [2, 1, 0]);
    assert_eq!(found(&["--tag", "0/0x1"]), [3]);
    assert_eq!(found(&["--since", "1"]), [3]);
    assert!(found(&["--since", "1", "--tag", "1/1"]).is_empty());
    assert_eq!(found(&["--since", "0"]), [2, 3, 1, 0]);
    let uid = server.revision("line", 1)["uid"].take();
    let first = format!("1@{}", uid.as_str().unwrap());
    assert_eq!(found(&["--since", &first]), [3]);
    let knn = [
        "knn", "line", "-k", "1", "--state", "0", "--since", "1@other",
    ];
    assert_eq!(server.json(&knn).json_error(3)["reason"], "UID_MISMATCH");
}

#[test]
fn the_included_columns_are_printed() {
    let server = tagged_line();
    server
        .json(&["update", "line", "2", "--payload", "up"])
        .line();
    let all = "states,tags,revisions,payloads";
    let knn = ["knn", "line", "-k", "2", "--state", "21", "--include", all];
    let expected = json!({
        "ids": [2, 3], "distances": [1.0, 9.0], "states": [[20.0], [30.0]], "tags": [17, 2], "revisions": [1, 2],
        "payloads": ["dXA=", ""], "revision": server.revision("line", 3),
    });
    assert_eq!(server.json(&knn).line(), expected);
    let text = "\
state 1: 2 points at revision 3
  id  distance  tag  revision  state  payload
   2  1.0        17         1  20.0   up
   3  9.0         2         2  30.0
";
    assert_eq!(server.run(&knn).stdout, text);
    let tags = [
        "query",
        "line",
        "--radius",
        "1",
        "--state",
        "21",
        "--include",
        "tags",
    ];
    assert_eq!(
        server.json(&tags).line(),
        json!({"ids": [2], "distances": [1.0], "tags": [17], "revision": server.revision("line", 3)})
    );

    let scan = [
        "scan",
        "line",
        "--since",
        "1",
        "--include",
        "tags,payloads,states",
    ];
    assert_eq!(server.run(&scan).stdout, "id,x,tag,payload\n3,30.0,2,\n");
    let scan = ["scan", "line", "--tag", "2", "--include", "revisions"];
    assert_eq!(server.run(&scan).stdout, "id,revision\n3,2\n");
    assert_eq!(
        server.json(&scan).lines(),
        [json!({"id": 3, "revision": server.revision("line", 2)})]
    );
}

#[test]
fn a_scan_with_tags_reads_back_as_the_same_points() {
    let server = tagged_line();
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("line.csv");
    let file = file.to_str().unwrap();
    let scan = ["scan", "line", file, "--include", "tags,states"];
    assert_eq!(server.json(&scan).line()["point_count"], 4);
    let read = ["line", file, "--ids", "id", "--tags", "tag"];
    let insert = [&["insert"], &read[..]].concat();
    assert_eq!(server.json(&insert).line()["unchanged_count"], 4);
    let knn = [&["knn", "-k", "1"], &read[..]].concat();
    assert_eq!(server.json(&knn).lines()[3]["ids"], json!([3]));

    let tags = ["insert", "line", "-", "--tags", "kind"];
    let rows = "kind,x\n0xffffffffffffffff,50\n7,60\n";
    server.json_with(&tags, rows).line();
    let points = server.json(&["get", "line", "4", "5"]).lines();
    let (first, second) = (&points[0]["tag"], &points[1]["tag"]);
    assert_eq!((first, second), (&json!("18446744073709551615"), &json!(7)));
    let wrong = server.run_with(&tags, "x,kind\n1,-1\n");
    assert!(wrong.error(3).contains("stdin:2:2: \"-1\" is not a tag"));
}

#[test]
fn insert_prints_the_neighbours_that_are_asked_for() {
    let server = tagged_line();
    let rows = |options: &[&str]| {
        let insert = ["insert", "line", "-", "--min-separation", "1"];
        let lines = server.json_with(&[&insert[..], options].concat(), "20\n");
        let mut line = lines.lines().remove(0);
        assert_eq!(line["outcome"], "TOO_CLOSE", "nothing is stored");
        line["ids"].take()
    };
    assert_eq!(rows(&["--radius", "10"]), json!([2, 1, 3]));
    assert_eq!(rows(&["--radius", "10", "--knn", "2"]), json!([2, 1]));
    assert_eq!(rows(&["--knn", "9", "--neighbor-tag", "0/1"]), json!([3]));
    assert_eq!(rows(&["--knn", "9", "--since", "1"]), json!([3]));
    let insert = [
        "insert",
        "line",
        "-",
        "--knn",
        "1",
        "--include",
        "tags,states",
    ];
    let lines = server.json_with(&insert, "31\n").lines();
    let expected = json!({
        "id": 4, "outcome": "INSERTED", "ids": [3], "distances": [1.0], "states": [[30.0]], "tags": [2],
    });
    assert_eq!(lines[0], expected);
}

#[tokio::test(flavor = "multi_thread")]
async fn numbers_and_radii_scale_with_the_index() {
    const POINTS: usize = 1000;
    let server = Server::start();
    let line = server.index("line", "R1").await;
    let states = (0..POINTS).map(|x| [x as f64]);
    line.insert(states).await.unwrap();
    // The library's own formulas, which its suite compares with the paper's.
    let scaling = Scaling {
        k_factor: Some(2.0),
        radius_factor: Some(3000.0),
        radius_max: None,
    };
    let k = scaling.k(POINTS).unwrap();
    let dimension = "R1".parse::<Space>().unwrap().dimension();
    let radius = scaling.radius(POINTS, dimension).unwrap();
    let within = |radius: f64| 1 + 2 * (radius.floor() as usize);
    assert!(k > 1 && radius > 10.0 && radius < 100.0, "{k} {radius}");

    let found = |args: &[&str]| {
        let line = server.json(&[args, &["--state", "500"]].concat()).line();
        line["ids"].as_array().unwrap().len()
    };
    assert_eq!(found(&["knn", "line", "--k-factor", "2"]), k);
    assert_eq!(
        found(&["query", "line", "--radius-factor", "3000"]),
        within(radius)
    );
    let bounded = [
        "query",
        "line",
        "--radius-factor",
        "3000",
        "--radius-max",
        "4",
    ];
    assert_eq!(found(&bounded), within(4.0));
    let both = [
        "knn",
        "line",
        "-k",
        "7",
        "--radius-factor",
        "3000",
        "--radius-max",
        "2",
    ];
    assert_eq!(found(&both), within(2.0));

    let insert = ["insert", "line", "-", "--min-separation", "1"];
    let neighbors = |options: &[&str]| {
        let lines = server.json_with(&[&insert[..], options].concat(), "500\n");
        lines.lines()[0]["ids"].as_array().unwrap().len()
    };
    assert_eq!(neighbors(&["--k-factor", "2"]), k);
    assert_eq!(neighbors(&["--radius-factor", "3000"]), within(radius));
    let bounded = ["--radius-factor", "3000", "--radius-max", "4"];
    assert_eq!(neighbors(&bounded), within(4.0));
}

#[test]
fn options_that_contradict_each_other_are_wrong_usage() {
    for args in [
        &["knn", "a", "--state", "1", "-k", "1", "--k-factor", "2"][..],
        &["knn", "a", "--state", "1", "-k", "1", "--radius-max", "2"],
        &["knn", "a", "--state", "1", "-k", "1", "--tag", "2/1"],
        &[
            "knn",
            "a",
            "--state",
            "1",
            "-k",
            "1",
            "--include",
            "colours",
        ],
        &[
            "query",
            "a",
            "--state",
            "1",
            "--radius",
            "1",
            "--radius-factor",
            "1",
        ],
        &["query", "a", "--state", "1", "--radius-max", "1"],
        &["insert", "a", "-", "--since", "1"],
        &["insert", "a", "-", "--include", "tags"],
        &["insert", "a", "-", "--knn", "1", "--k-factor", "2"],
        &["insert", "a", "-", "--tag", "1/1"],
        &["update", "a", "1"],
        &["update", "a", "--tag", "1"],
    ] {
        run_alone(args).error(2);
    }
}

/// The fake server does not wait.
#[tokio::test(flavor = "multi_thread")]
async fn a_read_that_is_late_names_the_revision_it_waited_for() {
    let fake = Fake::start().await;
    let error = |args: &[&str]| {
        // The first call asks for the index, whose newest revision is 2.
        fake.tell([2]);
        fake.fail(|number, _| (number > 0).then(|| Status::deadline_exceeded("late")));
        let run = command(&fake.uri, args).output().unwrap();
        assert_eq!(run.status.code(), Some(4), "{run:?}");
        String::from_utf8(run.stderr).unwrap()
    };
    for read in [
        &["knn", "line", "-k", "1", "--state", "0"][..],
        &["query", "line", "--radius", "1", "--state", "0"],
        &["scan", "line"],
    ] {
        let ahead = error(&[read, &["--since", "3"]].concat());
        assert!(
            ahead.starts_with(
                "error: waited for revision 3, which --since names: line was at revision 2; then: "
            ),
            "{ahead}"
        );
        assert!(ahead.contains("--timeout"), "{ahead}");
        let known = error(&[read, &["--since", "2"]].concat());
        assert!(!known.contains("--since"), "{known}");
    }
}
