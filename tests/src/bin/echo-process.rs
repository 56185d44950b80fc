//! The bare echo, which `tests/network/run` compares the server with.

use std::process::ExitCode;

/// The server's own allocator, so that both are built alike.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    wayfold_server::use_small_pages();
    wayfold_tests::echo::main()
}
