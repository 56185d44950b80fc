//! The command line `wayfold`, for the suites to start.

use std::process::ExitCode;

fn main() -> ExitCode {
    wayfold_cli::main()
}
