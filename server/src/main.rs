//! The `wayfold-server` binary. Its code is in the library, so that tests run it in process.

use std::process::ExitCode;

/// A call takes less processor time with mimalloc than with the system's allocator.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    wayfold_server::main()
}
