//! The C ABI of Wayfold. `wayfold.h` is generated from these files.
//!
//! Every function that can fail returns a [`code::Code`]; the error of a thread's last failed call is kept for that
//! thread. A panic becomes `INTERNAL`, and never unwinds into the caller.

mod abi;
mod code;
mod failure;
mod options;
