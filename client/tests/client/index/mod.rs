//! [`Index`](wayfold::Index) in its forms, against brute force.

mod conformance;
mod feed;
mod memory;
mod model;
mod remote;
mod shared;
