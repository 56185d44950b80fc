//! The server, for the suites to start: cargo builds the programs of a package before it runs the package's tests.

use std::process::ExitCode;

/// A tenth less work for every call than the system's.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    wayfold_server::main()
}
