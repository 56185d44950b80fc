//! The README's programs run here verbatim against a server on another port.

use std::error::Error;

use wayfold::{Index, InsertOptions, Search};
use wayfold_tests::{Stubs, server};

const README: &str = include_str!("../../../README.md");
const THIS_FILE: &str = include_str!("readme.rs");
const ADDRESS: &str = "\"http://127.0.0.1:50051\"";

fn example(uri: &str) -> Result<(), Box<dyn Error>> {
    let index = Index::shared(uri, "arm")
        .create(&"R3*SO3:0.15".parse()?)
        .open()?;
    let pose = [0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0];
    let nearest = index.nearest(pose)?;
    let id = index.insert(pose)?;
    let near = index.insert_with(pose, InsertOptions::new().neighbors(Search::k(10)))?;
    index.flush()?;
    println!("{nearest:?} {id} {:?}", near.neighbors.neighbors);
    Ok(())
}

#[tokio::test]
async fn the_example_runs() {
    let server = server!();
    example(server.uri()).unwrap();
    let mut stubs = Stubs::connect(server.uri()).await;
    assert_eq!(stubs.describe("arm").await.point_count, 2);
}

#[test]
fn the_example_is_the_readmes() {
    let block = between(README, "```rust,no_run\n", "```");
    let body = between(block, "fn main()", "\n}");
    let readme = body.split_once('{').unwrap().1.replace(ADDRESS, "uri");
    let here = between(THIS_FILE, "\nfn example(", "\n}");
    let here = here.split_once('{').unwrap().1;
    assert_eq!(letters(here), letters(&readme));
}

/// Runs the lines of the quick start after the installation, in a shell where `wayfold` is the tested build.
#[test]
fn the_quick_start_runs() {
    let server = server!();
    let lines = between(README, "cargo install --path client/cli\n", "```");
    let script = format!("wayfold() {{ \"$WAYFOLD\" \"$@\"; }}\n{lines}");
    let shell = wayfold_tests::Process::spawn(
        std::process::Command::new("sh")
            .args(["-euc", &script])
            .env("WAYFOLD", env!("CARGO_BIN_EXE_cli-process"))
            .env("WAYFOLD_SERVER", server.uri()),
    );
    let finished = shell.finish();
    assert!(finished.status.success(), "{}", finished.stderr);
    let output = finished.stdout.join("\n");
    assert!(output.contains("2 points"), "{output}");
}

fn between<'a>(text: &'a str, start: &str, end: &str) -> &'a str {
    let (_, rest) = text.split_once(start).unwrap();
    rest.split_once(end).unwrap().0
}

/// Code without its comments and whitespace.
fn letters(code: &str) -> String {
    let lines = code.lines().map(|line| line.split(" //").next().unwrap());
    let code: String = lines.flat_map(str::split_whitespace).collect();
    [",]", ",)", ",}"]
        .iter()
        .fold(code, |code, end| code.replace(end, &end[1..]))
}
