//! The functions of the header, and the only unsafe code of the library.
//!
//! `index` makes, describes and frees an index, `write` stores and reads points, `search` answers, `points` are lists of
//! points, `server` opens the forms that have a server, `connection` is that of a shared one, and `meanwhile` tells the
//! places of own points in it. `pointers` checks the pointers of all of them.
//!
//! A handle may be used by several threads at once, except in the function that frees it. States are rows of
//! `count × width` numbers; `width` is checked against the space. Results are copied into the caller's buffers once.

#![expect(
    unsafe_code,
    reason = "C hands over pointers, which Rust cannot check beyond null"
)]

#[cfg(feature = "net")]
mod connection;
mod index;
#[cfg(feature = "net")]
mod meanwhile;
mod pointers;
mod points;
mod search;
#[cfg(feature = "net")]
mod server;
mod write;
