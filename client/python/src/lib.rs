//! The extension module `wayfold._wayfold` of the Python package `wayfold`.
//!
//! `index` is the class of all three forms, `open` connects the two that have a server, and `query` answers in the
//! shapes of scipy's `KDTree`. `content` is what pickling keeps. `rows` reads states from arrays, `points` and `search`
//! hold what goes in and comes out, and `error` raises. Every call of the index releases the interpreter's lock, and
//! works on copies: another thread of Python may write to an array meanwhile. A call that waits runs Python's signal handlers.

#![forbid(unsafe_code)]

mod content;
mod error;
mod index;
mod open;
mod points;
mod query;
mod rows;
mod search;
mod space;
mod timing;

use pyo3::prelude::pymodule;

#[pymodule(gil_used = true)]
mod _wayfold {
    #[pymodule_export]
    use crate::{
        content::restore,
        index::Index,
        open::{remote, shared},
        points::{
            Changes, ConnectionStatus, InsertedPoint, Meanwhile, MeanwhileAnswers, Neighbor,
            SearchResult, StoredPoint, StoredPoints, UnsentWrite,
        },
        search::{ScaledRadius, Scaling, Search},
        space::Space,
        timing::seconds_in_rust,
    };

    #[pymodule_init]
    fn init() {
        wayfold::set_interrupt_check(crate::error::is_interrupted);
    }
}
