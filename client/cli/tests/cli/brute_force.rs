//! Answers in JSON to thousands of states from files: they equal brute force.

use std::fs;

use serde_json::{Value, json};
use wayfold::Space;
use wayfold_index::{Linear, PointRef, Search};

use crate::{
    files::{f64s, npy},
    poses::{SPACE, pose},
    server::Server,
};

fn csv(poses: &[[f64; 7]]) -> String {
    let lines = poses.iter().map(|pose| {
        let numbers: Vec<String> = pose.iter().map(f64::to_string).collect();
        numbers.join(",") + "\n"
    });
    lines.collect()
}

fn npy_of(poses: &[[f64; 7]]) -> Vec<u8> {
    let shape = format!("({}, 7)", poses.len());
    npy("<f8", false, &shape, &f64s(poses.as_flattened()))
}

fn canonical(space: &Space, pose: &[f64; 7]) -> [f64; 7] {
    let mut row = *pose;
    space.canonicalize(&mut row).unwrap();
    row
}

/// The value as a parser of JSON reads it, which may round the last digit.
fn as_read(value: Value) -> Value {
    serde_json::from_str(&value.to_string()).unwrap()
}

#[test]
fn answers_of_thousands_of_points_equal_brute_force() {
    let server = Server::start();
    let directory = tempfile::tempdir().unwrap();
    let file = |name: &str, content: &[u8]| {
        let path = directory.path().join(name);
        fs::write(&path, content).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let space: Space = SPACE.parse().unwrap();
    server
        .json(&["create", "leg", "--space", "ompl-se2"])
        .line();
    server.json(&["create", "arm", "--space", SPACE]).line();
    let listed = server.json(&["list"]).lines();
    let names: Vec<&Value> = listed.iter().map(|index| &index["name"]).collect();
    assert_eq!(names, ["arm", "leg"]);

    // From CSV and npy, under assigned ids; more than one call's worth of rows.
    let poses: Vec<[f64; 7]> = (0..2_500).map(pose).collect();
    let (first, second) = poses.split_at(2_100);
    let first = file("first.csv", csv(first).as_bytes());
    let summary = server.json(&["insert", "arm", &first]).line();
    assert_eq!(summary["inserted_count"], 2_100);
    assert_eq!(summary["revision"], server.revision("arm", 3));
    assert_eq!(
        (&summary["first_id"], &summary["last_id"]),
        (&json!(0), &json!(2_099))
    );
    let second = file("second.npy", &npy_of(second));
    let summary = server.json(&["insert", "arm", &second]).line();
    let revision = server.revision("arm", 4);
    let expected = json!({
        "inserted_count": 400, "unchanged_count": 0, "replaced_count": 0, "too_close_count": 0,
        "first_id": 2_100, "last_id": 2_499, "revision": revision,
    });
    assert_eq!(summary, expected);
    let info = server.json(&["info", "arm"]).line();
    assert_eq!(
        (&info["point_count"], &info["revision"]),
        (&json!(2_500), &revision)
    );

    let mut points = Linear::new(space.clone());
    for (id, pose) in (0..).zip(&poses) {
        let row = &canonical(&space, pose);
        let (tag, revision) = (0, 1);
        points
            .insert(PointRef {
                id,
                tag,
                revision,
                row,
            })
            .unwrap();
    }
    let expected = |pose: &[f64; 7], search: &Search<'_>| {
        let found = points.search(&canonical(&space, pose), search).unwrap();
        let ids: Vec<u64> = found.neighbors.iter().map(|n| n.id).collect();
        let distances: Vec<f64> = found.neighbors.iter().map(|n| n.distance).collect();
        as_read(json!({"ids": ids, "distances": distances, "revision": revision}))
    };
    let queries: Vec<[f64; 7]> = (9_000..9_030).map(pose).collect();
    let all = |search: &Search<'_>| -> Vec<Value> {
        queries.iter().map(|pose| expected(pose, search)).collect()
    };
    let text = file("queries.csv", csv(&queries).as_bytes());
    let nearest = server.json(&["knn", "arm", &text, "-k", "7"]).lines();
    assert_eq!(nearest, all(&Search::nearest_k(7)));
    let binary = file("queries.npy", &npy_of(&queries));
    let within = server.json(&["query", "arm", &binary, "--radius", "0.3"]);
    let within = within.lines();
    assert!(within.iter().any(|line| line["ids"][1].is_u64()));
    assert_eq!(within, all(&Search::nearest_r(0.3)));
    let one = csv(&queries[..1]);
    let near = ["-k", "3", "--radius", "0.2", "--state", one.trim()];
    let nearest = server.json(&[&["knn", "arm"], &near[..]].concat()).line();
    let search = Search {
        radius: 0.2,
        ..Search::nearest_k(3)
    };
    assert_eq!(nearest, expected(&queries[0], &search));
    let stored = points.get(1_234).unwrap().row;
    let got = server.json(&["get", "arm", "1234"]).line();
    assert_eq!(got["state"], as_read(json!(stored)));

    // An insert reads the file of a scan: the same points under the same ids.
    let scanned = directory.path().join("scanned.csv");
    let scanned = scanned.to_str().unwrap();
    server.run(&["scan", "arm", scanned]);
    let again = server
        .json(&["insert", "arm", scanned, "--ids", "id"])
        .line();
    assert_eq!(
        (&again["unchanged_count"], &again["revision"]),
        (&json!(2_500), &revision)
    );
    server.json(&["create", "copy", "--space", SPACE]).line();
    server
        .json(&["insert", "copy", scanned, "--ids", "id"])
        .line();
    let copy = server.run(&["scan", "copy"]).stdout;
    assert_eq!(copy, fs::read_to_string(scanned).unwrap());
}
