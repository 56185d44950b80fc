//! The Wayfold client.
