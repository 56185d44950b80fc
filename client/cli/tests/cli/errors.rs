//! An error goes to standard error, has an exit status, and changes nothing.

use serde_json::json;
use wayfold::Client;

use crate::{
    fake::Fake,
    process::{closed_pipe, command, run_alone},
    server::Server,
};

#[test]
fn wrong_usage_is_status_2() {
    for args in [
        &["frobnicate"][..],
        &["create", "arm"],
        &["create", "arm", "--space", "R3*"],
        &["knn", "arm", "-k", "0", "--state", "1"],
        &["knn", "arm", "-k", "1"],
        &["knn", "arm", "-k", "1", "a.csv", "--state", "1"],
        &["query", "arm", "--radius", "-1", "--state", "1"],
        &["query", "arm", "--state", "1"],
        &["insert", "arm", "a.csv", "--min-separation", "nan"],
        &["get", "arm", "9223372036854775808"],
        &["get", "arm"],
        &["token", "create", "cell\t3", "--role", "read"],
        &["scan", "arm", "a.npy"],
        &["list", "--timeout", "5"],
        &["list", "--output", "xml"],
        &["token", "create", "", "--role", "read"],
        &["token", "create", "x", "--role=read", "--index=\u{7f}"],
        &[
            "token",
            "create",
            "x",
            "--role",
            "read",
            "--expires",
            "soon",
        ],
        &[
            "token",
            "create",
            "x",
            "--role",
            "read",
            "--expires",
            "2001-01-01T00:00:00Z",
        ],
    ] {
        run_alone(args).error(2);
    }
}

#[test]
fn a_token_that_others_can_read_is_warned_of() {
    let list = |server, output| {
        let token = ["--token", "wayfold_of_a_test", "--output", output];
        let to = ["list", "--server", server, "--timeout", "50ms"];
        run_alone(&[&to[..], &token].concat())
    };
    // No machine has this address.
    let run = list("http://192.0.2.1:1", "text");
    let message = run.error(4);
    assert!(
        message.starts_with("warning: the token goes to http://192.0.2.1:1 without TLS"),
        "{message}"
    );
    let run = list("http://192.0.2.1:1", "json");
    assert!(run.error(4).starts_with("{\"warning\":"), "{}", run.stderr);
    let run = list("http://127.0.0.1:1", "text");
    assert!(run.error(4).starts_with("error: "), "{}", run.stderr);
}

#[test]
fn help_and_version_are_no_errors() {
    for args in [&["--help"][..], &["insert", "--help"], &["--version"]] {
        let run = run_alone(args);
        assert_eq!((run.status, &*run.stderr), (Some(0), ""));
    }
    assert!(run_alone(&["--help"]).stdout.contains("Examples:"));
}

#[test]
fn no_server_is_named_with_what_to_do() {
    let run = run_alone(&["list", "--timeout", "50ms"]);
    let message = run.error(4);
    for part in [
        "http://127.0.0.1:0",
        "Connection refused",
        "50ms",
        "wayfold-server",
        "--server",
        "WAYFOLD_SERVER",
    ] {
        assert!(message.contains(part), "{message} has no {part:?}");
    }
    for (server, part) in [
        ("https://127.0.0.1:0", "https needs the certificate"),
        ("ftp://127.0.0.1:0", "only http"),
    ] {
        let run = run_alone(&["list", "--server", server]);
        assert!(run.error(2).contains(part), "{}", run.stderr);
    }
}

#[test]
fn refusals_of_the_server_are_status_3() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    server.run_with(&["insert", "line", "-", "--ids", "id"], "id,x\n1,0\n");
    let roadmap = ["create", "roadmap", "--space", "R1", "--payloads"];
    server.run(&[&roadmap[..], &["edges"]].concat());
    for (args, expected) in [
        (
            &[&roadmap[..], &["weighted-edges"]].concat()[..],
            "PAYLOAD_ENCODING_EDGES, not PAYLOAD_ENCODING_WEIGHTED_EDGES",
        ),
        (&["info", "nope"], "(NOT_FOUND)"),
        (&["knn", "nope", "-k", "1", "--state", "0"], "(NOT_FOUND)"),
        (&["delete", "nope"], "(NOT_FOUND)"),
        (&["get", "line", "1", "5"], "id 5 (NOT_FOUND)"),
        (&["create", "line", "--space", "R2"], "(ALREADY_EXISTS)"),
        (&["create", "Line", "--space", "R2"], "(INVALID_ARGUMENT)"),
        (
            &["knn", "line", "-k", "4000000000", "--state", "0"],
            "(RESOURCE_EXHAUSTED)",
        ),
    ] {
        let run = server.run(args);
        assert!(run.error(3).contains(expected), "{}", run.stderr);
    }
    let conflict = server.run_with(&["insert", "line", "-", "--ids", "id"], "id,x\n1,5\n");
    assert!(
        conflict.error(3).contains("--replace"),
        "{}",
        conflict.stderr
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_with_one_bad_row_is_named_and_not_sent() {
    let server = Server::start();
    server.index("arm", "R3*SO3:0.15").await;
    let good = "0,0,0,0,0,0,1\n".repeat(2500);
    let ids = |rows: &str| format!("id,x,y,z,qx,qy,qz,qw\n{rows}");
    for (args, rows, expected) in [
        (
            &[][..],
            "0,0,0,0,0,zero,1",
            "stdin:2501:6 (qz): \"zero\" is not a finite number",
        ),
        (
            &[],
            "0,inf,0,0,0,0,1",
            "stdin:2501:2 (y): \"inf\" is not a finite number",
        ),
        (
            &[],
            "0,0,0,0,0,0,2",
            "stdin:2501:4 (qx): the quaternion that begins here has norm 2",
        ),
        (
            &[],
            "1e200,0,0,0,0,0,1",
            "stdin:2501:1 (x): a magnitude above 1e150",
        ),
        (
            &[],
            "0,0,0,0,0,1",
            "stdin:2501: 6 numbers, where a state of R3*SO3:0.15 has 7",
        ),
        (
            &[],
            "0,0,0,0,0,,1",
            "stdin:2501:6 (qz): \"\" is not a finite number",
        ),
        (
            &["--ids", "id"],
            &ids("1,0,0,nan,0,0,0,1"),
            "stdin:2:4 (z): \"nan\" is not a finite number",
        ),
        (
            &["--ids", "id"],
            &ids("1.0,0,0,0,0,0,0,1"),
            "stdin:2:1: \"1.0\" is not an id",
        ),
        (
            &["--ids", "id"],
            &ids("7,0,0,0,0,0,0,1\n7,0,0,0,0,0,0,1"),
            "stdin:3:1: id 7 is given twice, first in line 2",
        ),
        (
            &["--ids", "name"],
            &ids("7,0,0,0,0,0,0,1"),
            "stdin: no column \"name\" in the header; there are id, x,",
        ),
        (
            &["--ids", "id"],
            "0,0,0,0,0,0,1",
            "stdin: --ids names a column of a CSV header",
        ),
        (&[], &ids("7,0,0,0,0,0,0,1"), "say --ids id if it is the id"),
        (
            &[],
            "0;0;0;0;0;0;1\n0;0;0;0;0;0;1",
            "stdin:1: 1 numbers, where a state of R3*SO3:0.15 has 7",
        ),
        (
            &[],
            "x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0",
            "stdin:1: the columns x, y, z, qw, qx, qy, qz are not in the order of R3*SO3:0.15: x, y, z, qx, qy, qz, qw",
        ),
    ] {
        let input = if expected.contains(":2501") {
            format!("{good}{rows}\n")
        } else {
            format!("{rows}\n")
        };
        let run = server.run_with(&[&["insert", "arm", "-"], args].concat(), &input);
        assert!(
            run.error(3).contains(expected),
            "{} has no {expected:?}",
            run.stderr
        );
    }
    let missing = server.run(&["insert", "arm", "no/such/file.csv"]);
    assert!(missing.error(3).contains("no/such/file.csv"));
    let client = Client::connect(&server.uri).await.unwrap();
    assert_eq!(client.index_info("arm").await.unwrap().revision.number, 0);
}

#[test]
fn rows_before_a_bad_one_are_answered() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    server.run_with(&["insert", "line", "-"], "0\n");
    let run = server.json_with(&["knn", "line", "-", "-k", "1"], "1\n2\nx\n3\n");
    assert_eq!(run.status, Some(3));
    assert_eq!(run.stdout.lines().count(), 2);
    assert!(
        run.stderr.contains(r#"stdin:3:1 (x): \"x\""#),
        "{}",
        run.stderr
    );
    let run = server.run(&["knn", "line", "-k", "1", "--state", "NaN"]);
    assert!(run.error(3).contains("--state: number 1 (x): \"NaN\""));
    let run = server.run(&["knn", "line", "-k", "1", "--state", "1,2"]);
    assert!(
        run.error(3)
            .contains("--state: 2 numbers, where a state of R1 has 1"),
        "{}",
        run.stderr
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_is_starting_is_waited_for() {
    let fake = Fake::start().await;
    fake.unavailable(3);
    let run = command(&fake.uri, &["list", "--output", "json"])
        .output()
        .unwrap();
    assert!(run.status.success());
    assert_eq!(fake.calls(), 4);

    fake.unavailable(usize::MAX);
    let run = command(&fake.uri, &["list", "--timeout", "1s"])
        .output()
        .unwrap();
    assert_eq!(run.status.code(), Some(4));
    let message = String::from_utf8(run.stderr).unwrap();
    assert!(
        message.contains("(UNAVAILABLE)") && message.contains("--timeout"),
        "{message}"
    );
    fake.fail(|_, _| None);
    fake.fall_silent();
    let run = command(&fake.uri, &["list", "--timeout", "50ms"])
        .output()
        .unwrap();
    assert_eq!(run.status.code(), Some(4));
}

#[test]
fn help_documents_every_status() {
    let help = run_alone(&["--help"]).stdout;
    let (_, statuses) = help.split_once("Exit status:\n").unwrap();
    for status in ["  0  ", "  1  ", "  2  ", "  3  ", "  4  "] {
        assert!(statuses.contains(status), "{statuses}");
    }
}

#[test]
fn an_error_in_json_is_one_line_on_standard_error() {
    let server = Server::start();
    server.run(&["create", "line", "--space", "R1"]);
    let rows = "id,x\n1,0\n2,5\n";
    server.run_with(&["insert", "line", "-", "--ids", "id"], rows);

    let missing = server.json(&["get", "line", "1", "7", "8"]);
    let error = missing.json_error(3);
    assert_eq!(error["code"], "NOT_FOUND");
    assert_eq!(error["reason"], "POINTS_NOT_FOUND");
    assert_eq!(error["ids"], json!([7, 8]));
    assert_eq!(error["metadata"]["ids"], "7,8");
    assert!(
        error["message"].as_str().unwrap().contains("7, 8"),
        "{error}"
    );

    let field = server.json(&["create", "Line", "--space", "R1"]);
    let error = field.json_error(3);
    assert_eq!(error["code"], "INVALID_ARGUMENT");
    assert_eq!(error["fields"][0]["field"], "name");

    let input = server.json_with(&["insert", "line", "-"], "0\nzero\n");
    let error = input.json_error(3);
    assert_eq!(
        (&error["code"], &error["reason"]),
        (&json!("INVALID_ARGUMENT"), &json!("INPUT"))
    );
    assert!(
        error["message"]
            .as_str()
            .unwrap()
            .starts_with("stdin:2:1 (x)")
    );
    assert_eq!(error.get("ids"), None);

    let error = run_alone(&["list", "--timeout", "50ms", "--output", "json"]).json_error(4);
    assert_eq!(
        (&error["code"], &error["reason"]),
        (&json!("UNAVAILABLE"), &json!("UNREACHABLE"))
    );

    for usage in [
        &["knn", "arm", "--output", "json"][..],
        &["--output=json", "frobnicate"],
    ] {
        let error = run_alone(usage).json_error(2);
        assert_eq!(
            (&error["code"], &error["reason"]),
            (&json!("INVALID_ARGUMENT"), &json!("USAGE"))
        );
        assert!(
            error["message"].as_str().unwrap().contains("Usage:"),
            "{error}"
        );
    }
}

/// A supervisor whose pipe for messages is gone.
#[test]
fn a_token_that_no_one_can_read_is_an_error() {
    let mut create = command(
        "http://127.0.0.1:0",
        &["token", "create", "cell", "--role", "read"],
    );
    let output = create.stderr(closed_pipe()).output().unwrap();
    assert_eq!(output.status.code(), Some(3), "{output:?}");
}
