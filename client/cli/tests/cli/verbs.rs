//! The output of each verb.

use serde_json::json;

use crate::server::Server;

#[test]
fn an_index_is_created_listed_described_and_deleted() {
    let server = Server::start();
    assert!(server.json(&["list"]).lines().is_empty());

    let created = server
        .json(&["create", "arm", "--space", "R3*SO3:0.15"])
        .line();
    assert_eq!(created["created"], true);
    let again = server
        .json(&["create", "arm", "--space", "mpnn-se3"])
        .line();
    assert_eq!(again["created"], false);
    assert_eq!(again["revision"], created["revision"]);
    assert!(
        server
            .run(&["create", "arm", "--space", "mpnn-se3"])
            .stdout
            .contains("exists already")
    );

    let edges = ["create", "roadmap", "--space", "R2", "--payloads", "edges"];
    assert_eq!(server.json(&edges).line()["payload_encoding"], "edges");
    let described = server.run(&["info", "roadmap"]).stdout;
    assert!(described.contains("payloads     edges"), "{described}");
    server.run(&["delete", "roadmap"]);

    let info = server.json(&["info", "arm"]).line();
    let expected = json!({
        "name": "arm", "space_text": "R3*SO3:0.15", "point_count": 0,
        "revision": {"uid": created["revision"]["uid"], "number": 0},
        "coordinate_count": 7, "dimension": 6, "memory_bytes": info["memory_bytes"],
    });
    assert_eq!(info, expected);
    assert_eq!(server.json(&["list"]).lines(), [info]);
    assert!(
        server
            .run(&["info", "arm"])
            .stdout
            .contains("7 (x, y, z, qx, qy, qz, qw)")
    );

    let deleted = server.json(&["delete", "arm"]).line();
    assert_eq!(
        deleted,
        json!({"name": "arm", "uid": created["revision"]["uid"], "deleted": true})
    );
    assert!(server.json(&["list"]).lines().is_empty());
}

#[test]
fn text_is_a_table() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    let inserted = server.run_with(
        &["insert", "line", "-", "--ids", "id"],
        "x,id\n0.5,7\n2,1000\n",
    );
    assert_eq!(
        inserted.stdout,
        "inserted 2, unchanged 0, replaced 0, too close 0; first id 7, last id 1000; revision 1\n"
    );
    let nearest = server.run(&["knn", "line", "-k", "5", "--state", "-0.5"]);
    let table = "state 1: 2 points at revision 1\n    id  distance\n     7  1.0\n  1000  2.5\n";
    assert_eq!(nearest.stdout, table);
    assert_eq!(
        server.run(&["get", "line", "7"]).stdout,
        "7  state 0.5  tag 0  revision 1\n"
    );
    let point = server.json(&["get", "line", "7"]).line();
    let first = server.revision("line", 1);
    assert_eq!(
        point,
        json!({"id": 7, "state": [0.5], "tag": 0, "revision": first})
    );
    assert_eq!(
        server.run(&["remove", "line", "7"]).stdout,
        "removed 1, missing 0; revision 2\n"
    );
    assert_eq!(
        server.run(&["list"]).stdout,
        "NAME  POINTS  REVISION  SPACE\nline       1         2  R1\n"
    );
    let removed = server.json(&["remove", "line", "1000", "77"]).line();
    let third = server.revision("line", 3);
    assert_eq!(
        removed,
        json!({"removed_count": 1, "missing_count": 1, "revision": third})
    );
}

#[test]
fn insert_tells_the_neighbours_each_row_had() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    let args = [
        "insert",
        "line",
        "-",
        "--knn",
        "2",
        "--min-separation",
        "0.5",
    ];
    let lines = server.json_with(&args, "0\n10\n10.25\n1\n").lines();
    let expected = [
        json!({"id": 0, "outcome": "INSERTED", "ids": [], "distances": []}),
        json!({"id": 1, "outcome": "INSERTED", "ids": [0], "distances": [10.0]}),
        json!({"id": null, "outcome": "TOO_CLOSE", "blocker": 1, "ids": [1, 0], "distances": [0.25, 10.25]}),
        json!({"id": 2, "outcome": "INSERTED", "ids": [0, 1], "distances": [1.0, 9.0]}),
        json!({
            "inserted_count": 3, "unchanged_count": 0, "replaced_count": 0, "too_close_count": 1, "first_id": 0,
            "last_id": 2, "revision": server.revision("line", 1),
        }),
    ];
    assert_eq!(lines, expected);

    // A given id is printed even if the row is left out; the same point again is unchanged.
    let args = [
        "insert",
        "line",
        "-",
        "--ids",
        "id",
        "--knn",
        "1",
        "--min-separation",
        "0.5",
    ];
    let lines = server.json_with(&args, "id,x\n50,1.25\n1,10\n").lines();
    assert_eq!(
        lines[0],
        json!({"id": 50, "outcome": "TOO_CLOSE", "blocker": 2, "ids": [2], "distances": [0.25]})
    );
    assert_eq!(
        lines[1],
        json!({"id": 1, "outcome": "UNCHANGED", "ids": [2], "distances": [9.0]})
    );
    assert_eq!(lines[2]["unchanged_count"], 1);

    let replaced = server
        .json_with(
            &["insert", "line", "-", "--ids", "id", "--replace"],
            "id,x\n1,20\n",
        )
        .line();
    assert_eq!(replaced["replaced_count"], 1);
}

#[test]
fn ids_from_2_to_the_53_up_are_strings() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    let rows = "id,x\n9007199254740991,0\n9007199254740993,1\n9223372036854775807,2\n";
    let inserted = server
        .json_with(&["insert", "line", "-", "--ids", "id"], rows)
        .line();
    assert_eq!(inserted["first_id"], json!(9_007_199_254_740_991_u64));
    assert_eq!(inserted["last_id"], json!("9223372036854775807"));
    let nearest = server
        .json(&["knn", "line", "-k", "2", "--state", "0"])
        .line();
    assert_eq!(
        nearest["ids"],
        json!([9_007_199_254_740_991_u64, "9007199254740993"])
    );
    let point = server.json(&["get", "line", "9007199254740993"]).line();
    assert_eq!(point["id"], json!("9007199254740993"));
}
