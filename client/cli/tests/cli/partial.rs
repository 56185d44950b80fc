//! The rows of an insert that took effect before its error.

use serde_json::json;

use crate::server::Server;

#[test]
fn the_rows_before_a_refused_call_are_summed_up() {
    let server = Server::with(|config| config.limits.max_points_per_index = 2500);
    server.run(&["create", "line", "--space", "R1"]);
    let rows: String = (0..4000).map(|x| format!("{x}\n")).collect();
    let run = server.json_with(&["insert", "line", "-"], &rows);
    let summary = run.lines_and(3).remove(0);
    assert_eq!(summary["inserted_count"], 2000);
    assert_eq!(
        (&summary["first_id"], &summary["last_id"]),
        (&json!(0), &json!(1999))
    );
    assert!(
        run.stderr
            .contains("the first 2000 of 4000 rows took effect"),
        "{}",
        run.stderr
    );
}

/// The client divides the only call. The neighbours of the rows are lost with the error, and their ids are not.
#[test]
fn the_rows_before_a_refused_part_of_a_call_are_summed_up() {
    let server = Server::with(|config| {
        config.limits.max_rows_per_call = 100;
        config.limits.max_points_per_index = 250;
    });
    let rows: String = (0..400).map(|x| format!("{x}\n")).collect();
    server.run(&["create", "line", "--space", "R1"]);
    let run = server.json_with(&["insert", "line", "-", "--knn", "1"], &rows);
    let lines = run.lines_and(3);
    let expected = json!({
        "inserted_count": 0, "unchanged_count": 0, "replaced_count": 0, "too_close_count": 0, "first_id": 0,
        "last_id": 199, "partial_count": 200, "partial_ids": Vec::from_iter(0..200),
        "revision": server.revision("line", 2),
    });
    assert_eq!(lines, [expected], "{}", run.stderr);

    server.run(&["create", "text", "--space", "R1"]);
    let run = server.run_with(&["insert", "text", "-"], &rows);
    assert_eq!(run.status, Some(3), "{}", run.stderr);
    assert_eq!(
        run.stdout,
        "inserted 0, unchanged 0, replaced 0, too close 0, 200 more by the call that failed; first id 0, last id 199; \
         revision 2\n"
    );
    let told = "the first 200 of 400 rows took effect";
    assert!(run.stderr.contains(told), "{}", run.stderr);
}
