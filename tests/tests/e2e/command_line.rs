//! The command line `wayfold` against a real server: every verb, its JSON, its exit status.

use std::fs;

use serde_json::{Value, json};
use wayfold_index::{Linear, PointRef, Search, Space};
use wayfold_tests::{Finished, Process, ServerProcess, States, server};

/// A server, and a directory for the files of the tour.
struct Desk {
    server: ServerProcess,
    directory: tempfile::TempDir,
}

impl Desk {
    fn new() -> Self {
        Self {
            server: server!(),
            directory: tempfile::tempdir().unwrap(),
        }
    }

    fn start(&self, arguments: &[&str]) -> Process {
        let arguments = [&["--server", self.server.uri()], arguments].concat();
        Process::start(env!("CARGO_BIN_EXE_cli-process"), &arguments)
    }

    /// The lines that a command prints.
    fn text(&self, arguments: &[&str]) -> Vec<String> {
        succeeded(self.start(arguments).finish())
    }

    /// The values that a command prints, one a line.
    fn json(&self, arguments: &[&str]) -> Vec<Value> {
        let lines = self.text(&[arguments, &["--output", "json"]].concat());
        lines.iter().map(|line| parsed(line)).collect()
    }

    fn one(&self, arguments: &[&str]) -> Value {
        let mut values = self.json(arguments);
        assert_eq!(values.len(), 1, "{arguments:?}: {values:?}");
        values.remove(0)
    }

    /// The exit status and the complaint of a command that fails.
    fn failed(&self, arguments: &[&str]) -> (i32, String) {
        let finished = self.start(arguments).finish();
        assert_eq!(finished.stdout, Vec::<String>::new(), "{arguments:?}");
        (finished.status.code().unwrap(), finished.stderr)
    }

    fn file(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        let path = self.directory.path().join(name);
        fs::write(&path, content).unwrap();
        path.to_str().unwrap().to_owned()
    }
}

fn succeeded(finished: Finished) -> Vec<String> {
    assert_eq!(finished.status.code(), Some(0), "{}", finished.stderr);
    assert_eq!(finished.stderr, "", "a pipe has no progress bar");
    finished.stdout
}

fn parsed(line: &str) -> Value {
    serde_json::from_str(line).unwrap_or_else(|error| panic!("{line}: {error}"))
}

fn csv(rows: &[f64], width: usize) -> String {
    let lines = rows.chunks(width).map(|row| {
        let numbers: Vec<String> = row.iter().map(f64::to_string).collect();
        numbers.join(",") + "\n"
    });
    lines.collect()
}

/// A file of float64 as numpy writes it, version 1.0.
fn npy(rows: &[f64], width: usize) -> Vec<u8> {
    let shape = format!("({}, {width})", rows.len() / width);
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
    let padded = (10 + header.len() + 1).next_multiple_of(64) - 10;
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((padded as u16).to_le_bytes());
    file.extend(format!("{header:<0$}\n", padded - 1).bytes());
    file.extend(rows.iter().flat_map(|number| number.to_le_bytes()));
    file
}

fn brute_force(space: &Space, rows: &[f64], ids: impl Iterator<Item = u64>) -> Linear {
    let mut points = Linear::new(space.clone());
    for (row, id) in rows.chunks(space.coordinates()).zip(ids) {
        let mut row = row.to_vec();
        space.canonicalize(&mut row).unwrap();
        points
            .insert(PointRef {
                id,
                tag: 0,
                revision: 1,
                row: &row,
            })
            .unwrap();
    }
    points
}

/// What a query's line must say, read back from text: reading costs a last digit, on both sides the same.
fn line(points: &Linear, state: &[f64], search: &Search<'_>, revision: u64) -> Value {
    let mut state = state.to_vec();
    points.space().canonicalize(&mut state).unwrap();
    let found = points.search(&state, search).unwrap().neighbors;
    let ids: Vec<u64> = found.iter().map(|n| n.id).collect();
    let distances: Vec<f64> = found.iter().map(|n| n.distance).collect();
    parsed(&json!({"ids": ids, "distances": distances, "revision": revision}).to_string())
}

#[test]
fn a_tour_of_the_verbs() {
    let desk = Desk::new();
    let space = Space::se3();
    let mut states = States::new(space.clone(), 17);

    let created = desk.one(&["create", "arm", "--space", "R3*SO3:0.15"]);
    assert_eq!(created["created"], true);
    let again = desk.one(&["create", "arm", "--space", "mpnn-se3"]);
    assert_eq!(
        (&again["created"], &again["uid"]),
        (&json!(false), &created["uid"])
    );
    desk.text(&["create", "leg", "--space", "ompl-se2"]);
    let listed = desk.json(&["list"]);
    let names: Vec<&Value> = listed.iter().map(|index| &index["name"]).collect();
    assert_eq!(names, ["arm", "leg"]);

    // From CSV and npy, under assigned ids; more than one call's worth of rows.
    let rows = states.rows(2_500);
    let (first, second) = rows.split_at(2_100 * 7);
    let summary = desk.one(&["insert", "arm", &desk.file("a.csv", csv(first, 7))]);
    assert_eq!(summary["inserted"], 2_100);
    assert_eq!(summary["revision"], 3);
    let base = summary["first_id"].as_u64().unwrap();
    assert_eq!(summary["last_id"], base + 2_099);
    let summary = desk.one(&["insert", "arm", &desk.file("b.npy", npy(second, 7))]);
    let expected = json!({
        "inserted": 400, "unchanged": 0, "replaced": 0, "too_close": 0,
        "first_id": base + 2_100, "last_id": base + 2_499, "revision": 4,
    });
    assert_eq!(summary, expected);
    let info = desk.one(&["info", "arm"]);
    assert_eq!(info["points"], 2_500);
    assert_eq!(info["revision"], 4);
    assert_eq!(info["uid"], created["uid"]);
    assert_eq!(info["space"], "R3*SO3:0.15");

    let points = brute_force(&space, &rows, base..);
    let asked = states.rows(30);
    let file = desk.file("asked.csv", csv(&asked, 7));
    let nearest = desk.json(&["knn", "arm", &file, "-k", "7"]);
    let expected = asked
        .chunks(7)
        .map(|state| line(&points, state, &Search::nearest_k(7), 4));
    assert_eq!(nearest, expected.collect::<Vec<_>>());
    let file = desk.file("asked.npy", npy(&asked, 7));
    let within = desk.json(&["query", "arm", &file, "--radius", "2.5"]);
    let expected = asked
        .chunks(7)
        .map(|state| line(&points, state, &Search::nearest_r(2.5), 4));
    assert_eq!(within, expected.collect::<Vec<_>>());
    let one = csv(&asked[..7], 7);
    let nearest = desk.one(&[
        "knn",
        "arm",
        "--state",
        one.trim(),
        "-k",
        "3",
        "--radius",
        "1.5",
    ]);
    let search = Search {
        radius: 1.5,
        ..Search::nearest_k(3)
    };
    assert_eq!(nearest, line(&points, &asked[..7], &search, 4));

    let (one, other) = (base.to_string(), (base + 1).to_string());
    let got = desk.json(&["get", "arm", &other, &one]);
    assert_eq!(
        (&got[0]["id"], &got[1]["id"]),
        (&json!(base + 1), &json!(base))
    );
    let stored = json!(points.get(base).unwrap().row).to_string();
    assert_eq!(got[1]["state"], parsed(&stored));
    let removed = desk.one(&["remove", "arm", &one, "999999"]);
    assert_eq!(removed, json!({"removed": 1, "missing": 1, "revision": 5}));

    // What a scan writes, an insert reads: the same points under the same ids.
    let scanned = desk.directory.path().join("scanned.csv");
    let scanned = scanned.to_str().unwrap();
    let told = desk.text(&["scan", "arm", scanned]);
    assert!(told[0].contains("2499 points at revision 5"), "{told:?}");
    assert_eq!(
        desk.text(&["scan", "arm"]).join("\n") + "\n",
        fs::read_to_string(scanned).unwrap()
    );
    let again = desk.one(&["insert", "arm", scanned, "--ids", "id"]);
    assert_eq!(
        (&again["unchanged"], &again["revision"]),
        (&json!(2_499), &json!(5))
    );
    desk.text(&["create", "copy", "--space", "R3*SO3:0.15"]);
    desk.text(&["insert", "copy", scanned, "--ids", "id"]);
    assert_eq!(desk.text(&["scan", "copy"]), desk.text(&["scan", "arm"]));

    assert_eq!(desk.one(&["delete", "copy"])["deleted"], true);
    desk.text(&["delete", "leg"]);
    assert_eq!(desk.json(&["list"]).len(), 1);
}

#[test]
fn an_insert_tells_the_neighbours_of_each_row() {
    let desk = Desk::new();
    desk.text(&["create", "plane", "--space", "R2"]);
    let rows = "name,x,y\n1,0,0\n2,3,4\n3,3,4.5\n4,0,1\n";
    let file = desk.file("plane.csv", rows);
    let insert = ["insert", "plane", &file, "--ids", "name", "--knn", "2"];
    let lines = desk.json(&[&insert[..], &["--min-separation", "0.75"]].concat());
    let expected = [
        json!({"id": 1, "outcome": "INSERTED", "ids": [], "distances": []}),
        json!({"id": 2, "outcome": "INSERTED", "ids": [1], "distances": [5.0]}),
        json!({"id": 3, "outcome": "TOO_CLOSE", "blocker": 2, "ids": [2, 1], "distances": [0.5, 29.25f64.sqrt()]}),
        json!({"id": 4, "outcome": "INSERTED", "ids": [1, 2], "distances": [1.0, 18f64.sqrt()]}),
        json!({"inserted": 3, "unchanged": 0, "replaced": 0, "too_close": 1, "first_id": 1, "last_id": 4, "revision": 1}),
    ];
    assert_eq!(lines, expected.map(|line| parsed(&line.to_string())));

    let moved = desk.file("moved.csv", "name,x,y\n1,0,0\n2,5,5\n");
    let insert = ["insert", "plane", &moved, "--ids", "name"];
    let (status, complaint) = desk.failed(&insert);
    assert_eq!(status, 3);
    assert!(
        complaint.contains("on_conflict") || complaint.contains("--replace"),
        "{complaint}"
    );
    let replaced = desk.one(&[&insert[..], &["--replace"]].concat());
    assert_eq!(
        (&replaced["unchanged"], &replaced["replaced"]),
        (&json!(1), &json!(1))
    );
}

#[test]
fn a_pipe_is_answered_line_by_line() {
    let desk = Desk::new();
    desk.text(&["create", "plane", "--space", "R2"]);
    let mut insert = desk.start(&["insert", "plane", "-", "--output", "json"]);
    for row in ["0,0", "1,0", "0,2"] {
        insert.say(row);
    }
    let inserted = succeeded(insert.finish());
    assert_eq!(parsed(&inserted[0])["inserted"], 3);

    // A planner that asks about a state, and about the next when it knows the answer.
    let mut knn = desk.start(&["knn", "plane", "-", "-k", "1", "--output", "json"]);
    for (row, distance) in [("0.25,0", 0.25), ("1,0.5", 0.5), ("0,3", 1.0)] {
        knn.say(row);
        let answer = parsed(&knn.line().expect("an answer"));
        assert_eq!(answer["distances"], json!([distance]));
    }
    assert_eq!(succeeded(knn.finish()), Vec::<String>::new());
}

#[test]
fn a_file_is_checked_whole_before_anything_is_sent() {
    let desk = Desk::new();
    desk.text(&["create", "arm", "--space", "R3*SO3:0.15"]);
    let mut rows = csv(&States::new(Space::se3(), 19).rows(3_000), 7);
    rows.push_str("0,0,0,0,0,0,1.5\n");
    let file = desk.file("bad.csv", rows);
    let (status, complaint) = desk.failed(&["insert", "arm", &file]);
    assert_eq!(status, 3);
    assert!(
        complaint.contains("3001") && complaint.contains("norm"),
        "{complaint}"
    );
    assert!(complaint.contains(&file), "{complaint}");
    assert_eq!(desk.one(&["info", "arm"])["points"], 0);
}

#[test]
fn errors_go_to_standard_error_with_their_status() {
    let desk = Desk::new();
    desk.text(&["create", "arm", "--space", "R2"]);
    for (arguments, status, part) in [
        (&["info", "nowhere"][..], 3, "nowhere"),
        (&["create", "arm", "--space", "R3"], 3, "R3"),
        (&["create", "Arm", "--space", "R3"], 3, "Arm"),
        (&["get", "arm", "5"], 3, "5"),
        (
            &["insert", "arm", "/nonexistent.csv"],
            3,
            "/nonexistent.csv",
        ),
        (&["knn", "arm", "-k", "1", "--state", "1,NaN"], 3, "NaN"),
        (&["knn", "arm", "-k", "1", "--state", "1,2,3"], 3, "3"),
        (&["create", "x", "--space", "R3*"], 2, "--space"),
        (&["knn", "arm", "-k", "1"], 2, "--state"),
        (&["query", "arm", "--state", "1,2"], 2, "--radius"),
        (&["fly"], 2, "fly"),
        (&["knn", "arm", "--state", "1,2", "-k", "0"], 2, "-k"),
    ] {
        let (found, complaint) = desk.failed(arguments);
        assert_eq!(found, status, "{arguments:?}: {complaint}");
        assert!(complaint.contains(part), "{arguments:?}: {complaint}");
    }
}

#[test]
fn a_server_that_is_not_there_is_named() {
    // Bound and not listening: nobody else can listen there meanwhile.
    let nobody = tokio::net::TcpSocket::new_v4().unwrap();
    nobody.bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let uri = format!("http://{}", nobody.local_addr().unwrap());
    let info = ["--server", &uri, "--timeout", "100ms", "info", "arm"];
    let finished = Process::start(env!("CARGO_BIN_EXE_cli-process"), &info).finish();
    assert_eq!(finished.status.code(), Some(4));
    assert!(finished.stderr.contains(&uri), "{}", finished.stderr);
}

#[test]
fn help_is_for_people() {
    let help = Process::start(env!("CARGO_BIN_EXE_cli-process"), &["--help"]);
    let help = succeeded(help.finish()).join("\n");
    for verb in [
        "create", "list", "info", "delete", "insert", "knn", "query", "get", "remove", "scan",
        "snapshot", "restore", "verify",
    ] {
        assert!(
            help.contains(&format!("\n  {verb} ")),
            "{verb} is missing from\n{help}"
        );
    }
    let help = Process::start(env!("CARGO_BIN_EXE_server-process"), &["--help"]);
    let help = succeeded(help.finish()).join("\n");
    for flag in ["--config", "--grpc", "--zenoh", "--data"] {
        assert!(help.contains(flag), "{flag} is missing from\n{help}");
    }
}
