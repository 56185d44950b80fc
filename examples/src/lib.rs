//! Sampling-based motion planners on Wayfold, with collision checking by parry: the programs `maze`, `bodies` and
//! `rigid`.
//!
//! Reading order: `planning` (the planners, which know no scene), `maze` and `bodies` (a scene and its pictures each),
//! `rigid` (a roadmap that several processes build together).

#![expect(
    clippy::new_without_default,
    clippy::len_without_is_empty,
    reason = "nobody but the programs and tests of this package calls it"
)]

pub mod bodies;
pub mod maze;
pub mod planning;
pub mod rigid;
