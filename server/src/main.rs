//! The `wayfold-server` binary; everything is in the library, so that tests run the same code in process.

use std::process::ExitCode;

fn main() -> ExitCode {
    wayfold_server::main()
}
