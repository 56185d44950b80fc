//! The peers in C++, behind the narrow interface that `cpp/peer.h` declares.
//!
//! This is the one place with `unsafe` code: calls into C++, and their results.
#![expect(unsafe_code, reason = "the peers are libraries in C++")]

use std::ptr::NonNull;

use wayfold_index::{Factor, Space};

use super::Structure;
use crate::{chart::Chart, data::Rows};

#[repr(C)]
struct PeerResult {
    ids: *const u32,
    count: usize,
    bound: f64,
}

/// A `Peer` of C++. Rust knows only pointers to it.
#[repr(C)]
struct Opaque {
    _private: [u8; 0],
}

unsafe extern "C" {
    fn nanoflann_static(width: usize, rows: *const f64, n: usize) -> *mut Opaque;
    fn ann_static(width: usize, rows: *const f64, n: usize) -> *mut Opaque;
    fn nanoflann_dynamic(width: usize, room: usize) -> *mut Opaque;
    fn ompl_gnat(
        cell: i32,
        repeats: usize,
        weight: f64,
        rows: *const f64,
        n: usize,
        room: usize,
    ) -> *mut Opaque;
    #[cfg(nigh)]
    fn nigh_dynamic(cell: i32, repeats: usize) -> *mut Opaque;
    fn peer_insert(peer: *mut Opaque, row: *const f64);
    fn peer_nearest(peer: *mut Opaque, query: *const f64, k: usize, more: bool) -> PeerResult;
    fn peer_within(peer: *mut Opaque, query: *const f64, radius: f64, more: bool) -> PeerResult;
    fn peer_free(peer: *mut Opaque);
    #[link_name = "heap_bytes"]
    safe fn peer_heap_bytes() -> usize;
}

/// The used bytes of the process's heap. Rust and C++ share one allocator here.
pub fn heap_bytes() -> usize {
    peer_heap_bytes()
}

/// A C++ structure, which is freed when this is dropped. Rows and queries have `width` numbers.
struct Handle {
    peer: NonNull<Opaque>,
    width: usize,
    /// The capacity in points. C++ holds pointers into their buffer.
    room: usize,
    points: usize,
}

impl Handle {
    fn new(peer: *mut Opaque, width: usize, points: usize, room: usize) -> Self {
        Handle {
            peer: NonNull::new(peer).expect("C++'s new does not return null"),
            width,
            room,
            points,
        }
    }

    fn insert(&mut self, row: &[f64]) {
        assert!(row.len() == self.width && self.points < self.room);
        self.points += 1;
        // SAFETY: the peer lives as long as `self`, reads `width` numbers of the row, and there is room.
        unsafe { peer_insert(self.peer.as_ptr(), row.as_ptr()) }
    }

    fn nearest(&mut self, query: &[f64], k: usize, more: bool) -> (&[u32], f64) {
        assert_eq!(query.len(), self.width);
        // SAFETY: as in `insert`; the result stays in place until the next search, which borrows `self`.
        unsafe { held(peer_nearest(self.peer.as_ptr(), query.as_ptr(), k, more)) }
    }

    fn within(&mut self, query: &[f64], radius: f64, more: bool) -> (&[u32], f64) {
        assert_eq!(query.len(), self.width);
        // SAFETY: as in `nearest`.
        unsafe {
            held(peer_within(
                self.peer.as_ptr(),
                query.as_ptr(),
                radius,
                more,
            ))
        }
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        // SAFETY: it was made by C++'s new, and no one else has it.
        unsafe { peer_free(self.peer.as_ptr()) }
    }
}

/// The ids that a peer found, and its new bound.
///
/// # Safety
/// The ids must stay in place for as long as the caller makes the borrow last.
unsafe fn held<'a>(found: PeerResult) -> (&'a [u32], f64) {
    if found.count == 0 {
        return (&[], found.bound);
    }
    // SAFETY: C++ returns a pointer to `count` ids; that they stay is the caller's promise.
    let ids = unsafe { std::slice::from_raw_parts(found.ids, found.count) };
    (ids, found.bound)
}

/// A tree over Euclidean coordinates, searched from each image of a query.
pub struct ChartedTree {
    chart: Chart,
    place: Vec<f64>,
    handle: Handle,
}

impl ChartedTree {
    /// nanoflann's static tree.
    pub fn nanoflann(chart: Chart, rows: &Rows) -> Self {
        Self::built(chart, rows, nanoflann_static)
    }

    /// ANN's tree.
    pub fn ann(chart: Chart, rows: &Rows) -> Self {
        Self::built(chart, rows, ann_static)
    }

    fn built(
        chart: Chart,
        rows: &Rows,
        make: unsafe extern "C" fn(usize, *const f64, usize) -> *mut Opaque,
    ) -> Self {
        let (width, n) = (chart.width(), rows.len());
        let mut placed = vec![0.0; n * width];
        for (place, row) in placed.chunks_exact_mut(width).zip(rows.iter()) {
            chart.place(row, place);
        }
        // SAFETY: it copies n rows of that width.
        let peer = unsafe { make(width, placed.as_ptr(), n) };
        ChartedTree {
            place: vec![0.0; width],
            handle: Handle::new(peer, width, n, n),
            chart,
        }
    }

    /// nanoflann's forest, empty.
    pub fn nanoflann_dynamic(chart: Chart, room: usize) -> Self {
        let width = chart.width();
        // SAFETY: it takes numbers alone.
        let peer = unsafe { nanoflann_dynamic(width, room) };
        ChartedTree {
            place: vec![0.0; width],
            handle: Handle::new(peer, width, 0, room),
            chart,
        }
    }
}

impl Structure for ChartedTree {
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
        let ChartedTree {
            chart,
            place,
            handle,
        } = self;
        chart.place(query, place);
        found.clear();
        let (ids, reach_2) = handle.nearest(place, k, false);
        found.extend_from_slice(ids);
        chart.images(place, reach_2, |image, _| {
            let (ids, reach_2) = handle.nearest(image, k, true);
            found.clear();
            found.extend_from_slice(ids);
            reach_2
        });
    }

    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
        let ChartedTree {
            chart,
            place,
            handle,
        } = self;
        chart.place(query, place);
        let reach_2 = chart.reach_2(radius);
        found.clear();
        found.extend_from_slice(handle.within(place, reach_2, false).0);
        chart.images(place, reach_2, |image, _| {
            let (ids, _) = handle.within(image, reach_2, true);
            found.clear();
            found.extend_from_slice(ids);
            reach_2
        });
    }

    fn insert(&mut self, row: &[f64]) {
        self.chart.place(row, &mut self.place);
        self.handle.insert(&self.place);
    }
}

/// The compile-time parameters of OMPL's GNAT and of nigh: a cell of `cpp/gnat.cpp`, its number of repeats in a row, and the weight
/// of its rotation.
#[derive(Clone, Copy)]
pub struct Shape {
    cell: i32,
    repeats: usize,
    weight: f64,
}

impl Shape {
    /// True if nigh has this metric: its products add the distances of their factors, except those of circles.
    pub fn is_of_nigh(&self) -> bool {
        let is_compiled = match self.cell {
            0 => [3, 6, 12, 30].contains(&self.repeats),
            1 => [3, 6].contains(&self.repeats),
            cell => cell == 2 || cell == 5,
        };
        is_compiled && self.weight == 1.0
    }

    /// The shape for a space; None if GNAT is not compiled for it.
    pub fn of(space: &Space) -> Option<Shape> {
        let shape = |cell, repeats, weight| Shape {
            cell,
            repeats,
            weight,
        };
        let radians = Factor::so2();
        let [group] = space.groups() else {
            let [straight, rotation] = space.groups() else {
                return None;
            };
            let is_sum = straight.weight == 1.0
                && straight.terms == [Factor::RealVector(3).into()]
                && rotation.terms == [Factor::SO3.into()];
            return is_sum.then(|| shape(5, 1, rotation.weight));
        };
        if group.weight != 1.0 {
            return None;
        }
        let terms = group.terms.as_slice();
        match terms.iter().map(|term| (term.factor, term.weight)).next()? {
            (Factor::RealVector(n), 1.0) if terms.len() == 1 => Some(shape(0, n, 1.0)),
            (factor, 1.0) if factor == radians && terms.iter().all(|term| *term == terms[0]) => {
                Some(shape(1, terms.len(), 1.0))
            }
            (Factor::SO3, weight) if terms.len() == 1 => Some(shape(2, 1, weight)),
            (Factor::RealVector(2), 1.0) if terms[1..] == [radians.into()] => {
                Some(shape(3, 1, 1.0))
            }
            (Factor::RealVector(3), 1.0) if terms.len() % 2 == 0 => {
                let is_body = |pair: &[wayfold_index::Term]| {
                    pair[0] == terms[0] && pair[1] == terms[1] && pair[1].factor == Factor::SO3
                };
                let are_bodies = terms.chunks_exact(2).all(is_body);
                are_bodies.then(|| shape(4, terms.len() / 2, terms[1].weight))
            }
            _ => None,
        }
    }
}

/// A structure that measures in the space's own metric.
pub struct MetricTree(Handle);

impl MetricTree {
    /// OMPL's GNAT of these rows, with room for `room` rows in all.
    pub fn gnat(shape: Shape, width: usize, rows: &[f64], room: usize) -> Self {
        let n = rows.len() / width;
        assert!(n <= room);
        let Shape {
            cell,
            repeats,
            weight,
        } = shape;
        // SAFETY: it copies n rows of the width that the shape has, into room for more.
        let peer = unsafe { ompl_gnat(cell, repeats, weight, rows.as_ptr(), n, room) };
        MetricTree(Handle::new(peer, width, n, room))
    }

    /// nigh's tree, empty.
    #[cfg(nigh)]
    pub fn nigh(shape: Shape, width: usize, room: usize) -> Self {
        // SAFETY: it takes numbers alone.
        let peer = unsafe { nigh_dynamic(shape.cell, shape.repeats) };
        MetricTree(Handle::new(peer, width, 0, room))
    }
}

impl Structure for MetricTree {
    fn nearest(&mut self, query: &[f64], k: usize, found: &mut Vec<u32>) {
        found.clear();
        found.extend_from_slice(self.0.nearest(query, k, false).0);
    }

    fn within(&mut self, query: &[f64], radius: f64, found: &mut Vec<u32>) {
        found.clear();
        found.extend_from_slice(self.0.within(query, radius, false).0);
    }

    fn insert(&mut self, row: &[f64]) {
        self.0.insert(row);
    }
}
