//! The server, which the suites start: cargo builds the programs of a package before it runs the package's tests.

use std::process::ExitCode;

/// The server's own allocator: with the system's, a call takes more processor time.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    wayfold_server::main()
}
