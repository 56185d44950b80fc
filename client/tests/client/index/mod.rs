//! [`Index`](wayfold::Index) in its forms, against brute force.

mod conformance;
mod memory;
mod model;
mod remote;
mod shared;
