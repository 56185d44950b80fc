//! The `wayfold-server` binary; everything is in the library, so that tests run the same code in process.

use std::process::ExitCode;

/// A tenth less work for every call than the system's.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    wayfold_server::main()
}
