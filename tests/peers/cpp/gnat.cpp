// OMPL's GNAT without locks, OMPL's choice for planners with one thread, over states that the planner holds.
//
// A distance is a function of the space, compiled for it and called through std::function, as the library requires.
// OMPL's own state spaces make a virtual call for each factor and would be slower.
#include "peer.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <iostream> // for the next, which forgets it
#include <ompl/datastructures/NearestNeighborsGNATNoThreadSafety.h>
#include <ompl/util/RandomNumbers.h>
#include <vector>

namespace {

using State = const double *;

double square(double x) { return x * x; }

double arc(double a, double b) {
    const double d = std::fabs(a - b);
    return std::min(d, 2 * M_PI - d);
}

// The distance of OMPL's SO3StateSpace::distance, except that small angles do not count as 0.
double angle(State a, State b) {
    return std::acos(std::min(std::fabs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]), 1.0));
}

double straight_2(State a, State b, int n) {
    double sum = 0;
    for (int i = 0; i < n; i++) {
        sum += square(a[i] - b[i]);
    }
    return sum;
}

// The cells of the measured spaces: their coordinates, and the squared distance in one cell.
struct Line {
    static constexpr int width = 1;
    static double distance_2(State a, State b, double) { return square(a[0] - b[0]); }
};
struct Circle {
    static constexpr int width = 1;
    static double distance_2(State a, State b, double) { return square(arc(a[0], b[0])); }
};
struct Rotation {
    static constexpr int width = 4;
    static double distance_2(State a, State b, double weight) { return weight * square(angle(a, b)); }
};
struct Plane {
    static constexpr int width = 3;
    static double distance_2(State a, State b, double) { return straight_2(a, b, 2) + square(arc(a[2], b[2])); }
};
struct Body {
    static constexpr int width = 7;
    static double distance_2(State a, State b, double weight) {
        return straight_2(a, b, 3) + weight * square(angle(a + 3, b + 3));
    }
};

class Gnat : public Peer {
public:
    using Distance = std::function<double(const State &, const State &)>;

    Gnat(std::size_t width, const Distance &distance, const double *rows, std::size_t n, std::size_t room)
        : width(width) {
        tree.setDistanceFunction(distance);
        // States must stay where they are: the structure holds pointers to them.
        states.reserve(room * width);
        states.assign(rows, rows + n * width);
        std::vector<State> all;
        for (std::size_t at = 0; at < n; at++) {
            all.push_back(states.data() + at * width);
        }
        tree.add(all);
    }

    void insert(const double *row) override {
        states.insert(states.end(), row, row + width);
        tree.add(states.data() + states.size() - width);
    }

    PeerResult nearest(const double *query, std::size_t k, bool) override {
        if (k == 1) {
            found.assign(1, tree.nearest(query));
        } else {
            tree.nearestK(query, k, found);
        }
        return report();
    }

    PeerResult within(const double *query, double radius, bool) override {
        tree.nearestR(query, radius, found);
        return report();
    }

private:
    PeerResult report() {
        ids.clear();
        for (State state : found) {
            ids.push_back((state - states.data()) / width);
        }
        return {ids.data(), ids.size(), 0};
    }

    std::size_t width;
    std::vector<double> states;
    ompl::NearestNeighborsGNATNoThreadSafety<State> tree;
    std::vector<State> found;
    std::vector<std::uint32_t> ids;
};

// One group: the root of the sum over all cells.
template <class Cell>
Peer *product(std::size_t repeats, double weight, const double *rows, std::size_t n, std::size_t room) {
    const auto distance = [repeats, weight](const State &a, const State &b) {
        double sum = 0;
        for (std::size_t at = 0; at < repeats * Cell::width; at += Cell::width) {
            sum += Cell::distance_2(a + at, b + at, weight);
        }
        return std::sqrt(sum);
    };
    return new Gnat(repeats * Cell::width, distance, rows, n, room);
}

} // namespace

extern "C" Peer *ompl_gnat(int cell, std::size_t repeats, double weight, const double *rows, std::size_t n,
                           std::size_t room) {
    // The same pivots in every run. The library takes one seed, before its first structure is made.
    static const bool once = (ompl::RNG::setSeed(1), true);
    static_cast<void>(once);
    switch (cell) {
    case 0:
        return product<Line>(repeats, weight, rows, n, room);
    case 1:
        return product<Circle>(repeats, weight, rows, n, room);
    case 2:
        return product<Rotation>(repeats, weight, rows, n, room);
    case 3:
        return product<Plane>(repeats, weight, rows, n, room);
    case 4:
        return product<Body>(repeats, weight, rows, n, room);
    default: {
        // OMPL's SE3 adds the distances of position and rotation.
        const auto sum = [weight](const State &a, const State &b) {
            return std::sqrt(straight_2(a, b, 3)) + weight * angle(a + 3, b + 3);
        };
        return new Gnat(Body::width, sum, rows, n, room);
    }
    }
}
