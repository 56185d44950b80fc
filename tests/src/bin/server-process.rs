//! The server, for the suites to start: cargo builds the programs of a package before it runs the package's tests.

use std::process::ExitCode;

fn main() -> ExitCode {
    wayfold_server::main()
}
