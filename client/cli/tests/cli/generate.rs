//! Completions and manual pages, which need no server.

use crate::process::run_alone;

#[test]
fn completions_name_every_verb() {
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let run = run_alone(&["completions", shell]);
        assert_eq!((run.status, &*run.stderr), (Some(0), ""), "{shell}");
        for part in ["update", "verify", "completions", "radius-factor"] {
            assert!(run.stdout.contains(part), "{shell} has no {part}");
        }
    }
    run_alone(&["completions", "tcl"]).error(2);
}

#[test]
fn manual_pages_describe_the_program_and_its_commands() {
    let page = |args: &[&str]| {
        let run = run_alone(&[&["man"], args].concat());
        assert_eq!((run.status, &*run.stderr), (Some(0), ""), "{args:?}");
        // In roff a hyphen is `\-`.
        run.stdout.replace("\\-", "-")
    };
    let program = page(&[]);
    for part in [
        ".TH wayfold 1",
        "Exit status",
        "wayfold-update",
        "--timeout",
    ] {
        assert!(program.contains(part), "no {part:?} in {program}");
    }
    let knn = page(&["knn"]);
    for part in [".TH wayfold-knn 1", "--k-factor", "--include", "--timeout"] {
        assert!(knn.contains(part), "no {part:?} in {knn}");
    }
    run_alone(&["man", "fly"]).error(2);
}
