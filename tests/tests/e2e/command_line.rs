//! The command line `wayfold` against a server process: its answers equal brute force. The suite of `client/cli` holds
//! the rest of its behaviour.

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

/// The expected line of a query, read back from text: reading costs a last digit, on both sides the same.
fn line(points: &Linear, state: &[f64], search: &Search<'_>, revision: &Value) -> Value {
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
        (&again["created"], &again["revision"]),
        (&json!(false), &created["revision"])
    );
    let revision = |number: u64| json!({"uid": created["revision"]["uid"], "number": number});
    desk.text(&["create", "leg", "--space", "ompl-se2"]);
    let listed = desk.json(&["list"]);
    let names: Vec<&Value> = listed.iter().map(|index| &index["name"]).collect();
    assert_eq!(names, ["arm", "leg"]);

    // From CSV and npy, under assigned ids; more than one call's worth of rows.
    let rows = states.rows(2_500);
    let (first, second) = rows.split_at(2_100 * 7);
    let summary = desk.one(&["insert", "arm", &desk.file("a.csv", csv(first, 7))]);
    assert_eq!(summary["inserted_count"], 2_100);
    assert_eq!(summary["revision"], revision(3));
    let base = summary["first_id"].as_u64().unwrap();
    assert_eq!(summary["last_id"], base + 2_099);
    let summary = desk.one(&["insert", "arm", &desk.file("b.npy", npy(second, 7))]);
    let expected = json!({
        "inserted_count": 400, "unchanged_count": 0, "replaced_count": 0, "too_close_count": 0,
        "first_id": base + 2_100, "last_id": base + 2_499, "revision": revision(4),
    });
    assert_eq!(summary, expected);
    let info = desk.one(&["info", "arm"]);
    assert_eq!(info["point_count"], 2_500);
    assert_eq!(info["revision"], revision(4));
    assert_eq!(info["space"], "R3*SO3:0.15");

    let points = brute_force(&space, &rows, base..);
    let asked = states.rows(30);
    let file = desk.file("asked.csv", csv(&asked, 7));
    let nearest = desk.json(&["knn", "arm", &file, "-k", "7"]);
    let expected = asked
        .chunks(7)
        .map(|state| line(&points, state, &Search::nearest_k(7), &revision(4)));
    assert_eq!(nearest, expected.collect::<Vec<_>>());
    let file = desk.file("asked.npy", npy(&asked, 7));
    let within = desk.json(&["query", "arm", &file, "--radius", "2.5"]);
    let expected = asked
        .chunks(7)
        .map(|state| line(&points, state, &Search::nearest_r(2.5), &revision(4)));
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
    assert_eq!(nearest, line(&points, &asked[..7], &search, &revision(4)));

    let (one, other) = (base.to_string(), (base + 1).to_string());
    let got = desk.json(&["get", "arm", &other, &one]);
    assert_eq!(
        (&got[0]["id"], &got[1]["id"]),
        (&json!(base + 1), &json!(base))
    );
    let stored = json!(points.get(base).unwrap().row).to_string();
    assert_eq!(got[1]["state"], parsed(&stored));
    let removed = desk.one(&["remove", "arm", &one, "999999"]);
    let expected = json!({"removed_count": 1, "missing_count": 1, "revision": revision(5)});
    assert_eq!(removed, expected);

    // An insert reads the file of a scan: the same points under the same ids.
    let scanned = desk.directory.path().join("scanned.csv");
    let scanned = scanned.to_str().unwrap();
    let written = desk.text(&["scan", "arm", scanned]);
    assert!(
        written[0].contains("2499 points at revision 5"),
        "{written:?}"
    );
    assert_eq!(
        desk.text(&["scan", "arm"]).join("\n") + "\n",
        fs::read_to_string(scanned).unwrap()
    );
    let again = desk.one(&["insert", "arm", scanned, "--ids", "id"]);
    assert_eq!(
        (&again["unchanged_count"], &again["revision"]),
        (&json!(2_499), &revision(5))
    );
    desk.text(&["create", "copy", "--space", "R3*SO3:0.15"]);
    desk.text(&["insert", "copy", scanned, "--ids", "id"]);
    assert_eq!(desk.text(&["scan", "copy"]), desk.text(&["scan", "arm"]));

    assert_eq!(desk.one(&["delete", "copy"])["deleted"], true);
    desk.text(&["delete", "leg"]);
    assert_eq!(desk.json(&["list"]).len(), 1);
}
