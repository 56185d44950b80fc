//! A C-shaped body in a maze with narrow corridors: the scene, and the pictures of the trees in it.

pub mod picture;
pub mod scene;
pub mod shared_picture;
pub mod star_picture;
