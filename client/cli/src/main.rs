//! The command line `wayfold`.

use std::process::ExitCode;

fn main() -> ExitCode {
    wayfold_cli::main()
}
