//! Eight rigid bodies between three pillars: the scene, and the picture of the trees in it.

pub mod picture;
pub mod scene;

mod projection;
