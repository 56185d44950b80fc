//! The Wayfold server.
fn main() {}
