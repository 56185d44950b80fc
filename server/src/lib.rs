//! The Wayfold server.
