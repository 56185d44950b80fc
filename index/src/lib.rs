//! Exact dynamic nearest-neighbour search.
