//! The program `wayfold`, which the suites start.

use std::process::ExitCode;

fn main() -> ExitCode {
    wayfold_cli::main()
}
