//! The text and the files of `scan`.

use serde_json::json;

use crate::server::Server;

#[test]
fn a_scan_reads_back_as_the_same_points() {
    let server = Server::start();
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("roadmap.csv");
    let file = file.to_str().unwrap();
    server.run(&["create", "torus", "--space", "R2*SO2^2"]);
    // Angles beyond the seam, and numbers without a short decimal form.
    let rows = "0.1,0.30000000000000004,3.5,-7\n1e-300,-1e149,0,6.283185307179586\n0.3333333333333333,5,1,2\n";
    server.run_with(&["insert", "torus", "-"], rows);

    let printed = server.run(&["scan", "torus"]);
    assert_eq!(printed.stdout.lines().next(), Some("id,x,y,theta0,theta1"));
    assert_eq!(printed.stdout.lines().count(), 4);
    let written = server.json(&["scan", "torus", file]).line();
    let first = server.revision("torus", 1);
    assert_eq!(written, json!({"point_count": 3, "revision": first}));
    // JSON concerns what is printed, not the file.
    assert_eq!(std::fs::read_to_string(file).unwrap(), printed.stdout);
    std::fs::remove_file(file).unwrap();

    let again = server.run(&["scan", "torus", file]);
    assert!(
        again
            .stdout
            .starts_with("3 points at revision 1 written to "),
        "{}",
        again.stdout
    );
    assert_eq!(std::fs::read_to_string(file).unwrap(), printed.stdout);
    let unchanged = server
        .json(&["insert", "torus", file, "--ids", "id"])
        .line();
    assert_eq!(
        unchanged["unchanged_count"], 3,
        "canonical states read back to the bit"
    );
    assert_eq!(unchanged["revision"], first);

    let points = server.json(&["scan", "torus"]).lines();
    assert_eq!(points[0]["state"][2], json!(3.5 - std::f64::consts::TAU));
    assert_eq!(points[1], server.json(&["get", "torus", "1"]).line());

    // The rows of a scan as queries.
    let own = server
        .json(&["knn", "torus", file, "--ids", "id", "-k", "1"])
        .lines();
    let nearest: Vec<_> = own.iter().map(|line| line["ids"][0].clone()).collect();
    assert_eq!(nearest, [json!(0), json!(1), json!(2)]);
}

#[cfg(unix)]
#[test]
fn a_scan_follows_links_to_files_and_to_pipes() {
    let server = Server::start();
    let directory = tempfile::tempdir().unwrap();
    server.run(&["create", "line", "--space", "R1"]);
    server.run_with(&["insert", "line", "-"], "0.5\n");
    let scan = "id,x\n0,0.5\n";
    let link_to = |target: &std::path::Path| {
        let link = directory.path().join("link");
        std::os::unix::fs::symlink(target, &link).unwrap();
        let run = server.run(&["scan", "line", link.to_str().unwrap()]);
        assert_eq!((run.status, &*run.stderr), (Some(0), ""));
        assert!(link.is_symlink());
        std::fs::remove_file(link).unwrap();
        run.stdout
    };
    let file = directory.path().join("file.csv");
    std::fs::write(&file, "old").unwrap();
    link_to(&file);
    assert_eq!(std::fs::read_to_string(&file).unwrap(), scan);
    assert!(link_to("/dev/stdout".as_ref()).starts_with(scan));
}
