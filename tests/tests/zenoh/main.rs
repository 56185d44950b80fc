//! The Zenoh interface from outside: servers in processes of their own, and sessions over loopback.

#![expect(
    clippy::unwrap_used,
    reason = "a test says what went wrong by where it panics"
)]

mod cluster;
mod documented;
mod faults;
mod feed;
mod follower;
mod life;
mod load;
mod mute;
mod parity;
mod robot;
mod scan;
mod shared;
mod talk;
