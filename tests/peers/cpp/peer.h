// The narrow interface to a measured library in C++, exactly as foreign.rs declares it.
//
// Points have the ids 0, 1, 2, … in the order in which they came. The result of a search stays valid until the next
// search. No function throws to the caller, except that running out of memory ends the process.
#pragma once

#include <cstddef>
#include <cstdint>

// The result of a search. `bound` is in the structure's own measure: points beyond it cannot change the answer
// (infinity as long as too few are held).
struct PeerResult {
    const std::uint32_t *ids;
    std::size_t count;
    double bound;
};

class Peer {
public:
    virtual ~Peer() = default;

    // Only for structures that are built empty.
    virtual void insert(const double *row) = 0;

    // The k nearest; with `more`, the k nearest to this query and to those since the last without `more`.
    virtual PeerResult nearest(const double *query, std::size_t k, bool more) = 0;

    // All within a radius (the squared one, of structures that measure squares); `more` as above.
    virtual PeerResult within(const double *query, double radius, bool more) = 0;
};

extern "C" {
// Each holds a copy of the n rows of `width` numbers. The first two measure squared Euclidean distances.
Peer *nanoflann_static(std::size_t width, const double *rows, std::size_t n);
Peer *ann_static(std::size_t width, const double *rows, std::size_t n);
// With room for `room` points, and no more.
Peer *nanoflann_dynamic(std::size_t width, std::size_t room);
// Rows are `repeats` times the coordinates of a cell; `weight` is that of its rotation. Cells: see gnat.cpp.
// With n rows, and room for `room` in all; measures distances, not squared.
Peer *ompl_gnat(int cell, std::size_t repeats, double weight, const double *rows, std::size_t n, std::size_t room);
// Cells as for GNAT, with the weight 1. Returns null for a metric that is not compiled in.
Peer *nigh_dynamic(int cell, std::size_t repeats);

void peer_insert(Peer *peer, const double *row);
PeerResult peer_nearest(Peer *peer, const double *query, std::size_t k, bool more);
PeerResult peer_within(Peer *peer, const double *query, double radius, bool more);
void peer_free(Peer *peer);

// The bytes in use of the process's heap, whoever asked for them.
std::size_t heap_bytes();
}
