//! The command line `wayfold`.

use std::process::ExitCode;

fn main() -> ExitCode {
    wayfold_client::cli::main()
}
