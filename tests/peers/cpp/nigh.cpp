// nigh's kd-tree by Ichnowski and Alterovitz, without locks. Compiled only if NIGH names a checkout.
//
// Its metric of a product adds the distances of the factors. The products that take the root of a sum of squares are
// not among its metrics, except that of circles.
#include "peer.h"

// nigh uses these two without including them.
#include <cassert>
#include <utility>

#include <limits>
#include <nigh/cartesian_space.hpp>
#include <nigh/kdtree_batch.hpp>
#include <nigh/lp_space.hpp>
#include <nigh/so2_space.hpp>
#include <nigh/so3_space.hpp>
#include <tuple>
#include <vector>

namespace {

namespace nigh = unc::robotics::nigh;

using Rotations = nigh::metric::SO3Space<double>;
template <int Width> using Straight = nigh::metric::L2Space<double, Width>;
template <int Width> using Circles = nigh::metric::SO2LPSpace<double, Width, 2>;
using Body = nigh::metric::CartesianSpace<Straight<3>, Rotations>;

// The states of the spaces, read from a row.
template <int Width> void read(const double *row, Eigen::Matrix<double, Width, 1> &state) {
    state = Eigen::Map<const Eigen::Matrix<double, Width, 1>>(row);
}
void read(const double *row, Eigen::Quaterniond &state) { state = Eigen::Map<const Eigen::Quaterniond>(row); }
void read(const double *row, Body::Type &state) {
    read(row, std::get<0>(state));
    read(row + 3, std::get<1>(state));
}

template <class Space> class Tree final : public Peer {
public:
    void insert(const double *row) override {
        Point point;
        read(row, point.state);
        point.id = static_cast<std::uint32_t>(tree.size());
        tree.insert(point);
    }

    PeerResult nearest(const double *query, std::size_t k, bool) override {
        if (k > 1) {
            return search(query, k, std::numeric_limits<double>::infinity());
        }
        State state;
        read(query, state);
        ids.clear();
        if (const auto found = tree.nearest(state)) {
            ids.push_back(found->first.id);
        }
        return {ids.data(), ids.size(), 0};
    }

    PeerResult within(const double *query, double radius, bool) override {
        // The library's own way to ask for all within a radius.
        return search(query, found.max_size(), radius);
    }

private:
    using State = typename Space::Type;
    struct Point {
        State state;
        std::uint32_t id;
    };
    struct StateOf {
        const State &operator()(const Point &point) const { return point.state; }
    };
    // The answers hold ids alone, so that the library moves no states.
    struct Id {
        std::uint32_t id;
        Id(const Point &point) : id(point.id) {}
    };

    PeerResult search(const double *query, std::size_t k, double radius) {
        State state;
        read(query, state);
        tree.nearest(found, state, k, radius);
        ids.clear();
        for (const auto &near : found) {
            ids.push_back(near.first.id);
        }
        return {ids.data(), ids.size(), 0};
    }

    nigh::Nigh<Point, Space, StateOf, nigh::NoThreadSafety, nigh::KDTreeBatch<>> tree;
    std::vector<std::pair<Id, double>> found;
    std::vector<std::uint32_t> ids;
};

} // namespace

extern "C" Peer *nigh_dynamic(int cell, std::size_t repeats) {
    switch (100 * cell + static_cast<int>(repeats)) {
    case 3:
        return new Tree<Straight<3>>();
    case 6:
        return new Tree<Straight<6>>();
    case 12:
        return new Tree<Straight<12>>();
    case 30:
        return new Tree<Straight<30>>();
    case 103:
        return new Tree<Circles<3>>();
    case 106:
        return new Tree<Circles<6>>();
    case 201:
        return new Tree<Rotations>();
    case 501:
        return new Tree<Body>();
    default:
        return nullptr;
    }
}
