// ANN by Mount and Arya, the library on which MPNN is based: its kd-tree, searched exactly.
#include "peer.h"

#include <ANN/ANN.h>
#include <algorithm>
#include <limits>
#include <utility>
#include <vector>

namespace {

// The fastest bucket size of 1 (the library's default), 4, 8, 16 and 32 in R3, R6, SE2 and SO3.
constexpr int bucket = 16;

class Tree final : public Peer {
public:
    Tree(int width, const double *rows, int n) : points(annAllocPts(n, width)) {
        std::copy(rows, rows + static_cast<std::size_t>(n) * width, points[0]);
        tree = new ANNkd_tree(points, n, width, bucket);
    }

    ~Tree() override {
        delete tree;
        annDeallocPts(points);
    }

    Tree(const Tree &) = delete;
    Tree &operator=(const Tree &) = delete;

    void insert(const double *) override {}

    PeerResult nearest(const double *query, std::size_t k, bool more) override {
        const int count = static_cast<int>(k);
        make_room(k);
        if (more) {
            const double bound = held.back().first;
            const int within = tree->annkFRSearch(place(query), bound, count, found.data(), distances.data());
            hold(std::min(within, count));
            std::sort(held.begin(), held.end());
            held.resize(k);
        } else {
            held.clear();
            tree->annkSearch(place(query), count, found.data(), distances.data());
            hold(count);
        }
        return report(held.back().first);
    }

    PeerResult within(const double *query, double radius, bool more) override {
        if (!more) {
            held.clear();
        }
        // This capacity makes a second search rare.
        const int guess = 64;
        make_room(guess);
        int within = tree->annkFRSearch(place(query), radius, guess, found.data(), distances.data());
        if (within > guess) {
            make_room(within);
            within = tree->annkFRSearch(place(query), radius, within, found.data(), distances.data());
        }
        hold(within);
        return report(radius);
    }

private:
    // The library reads a query through a pointer that is not const.
    static ANNpoint place(const double *query) { return const_cast<double *>(query); }

    void make_room(std::size_t k) {
        found.resize(std::max(k, found.size()));
        distances.resize(std::max(k, distances.size()));
    }

    void hold(int count) {
        for (int at = 0; at < count; at++) {
            held.emplace_back(distances[at], found[at]);
        }
    }

    PeerResult report(double bound) {
        ids.clear();
        for (const auto &near : held) {
            ids.push_back(near.second);
        }
        return {ids.data(), ids.size(), bound};
    }

    ANNpointArray points;
    ANNkd_tree *tree;
    std::vector<ANNidx> found;
    std::vector<double> distances;
    std::vector<std::pair<double, std::uint32_t>> held;
    std::vector<std::uint32_t> ids;
};

} // namespace

extern "C" Peer *ann_static(std::size_t width, const double *rows, std::size_t n) {
    return new Tree(static_cast<int>(width), rows, static_cast<int>(n));
}
