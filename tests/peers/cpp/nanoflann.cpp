// nanoflann's static tree, and its forest of static trees that takes points one by one.
//
// Its adaptors for SO2 and SO3 are not used: that for SO2 looks at one angle only and adds signed differences, so that
// it is neither a metric nor exact, and that for SO3 takes q and −q for two rotations. Images of the query are exact.
#include "peer.h"

#include <algorithm>
#include <limits>
#include <nanoflann.hpp>
#include <utility>
#include <vector>

namespace {

struct Cloud {
    std::size_t width;
    std::size_t points;
    std::vector<double> rows;

    std::size_t kdtree_get_point_count() const { return points; }
    double kdtree_get_pt(std::uint32_t at, std::size_t coordinate) const { return rows[at * width + coordinate]; }
    template <class Box> bool kdtree_get_bbox(Box &) const { return false; }
};

using Metric = nanoflann::L2_Simple_Adaptor<double, Cloud>;
template <int Width> using Static = nanoflann::KDTreeSingleIndexAdaptor<Metric, Cloud, Width>;
template <int Width> using Dynamic = nanoflann::KDTreeSingleIndexDynamicAdaptor<Metric, Cloud, Width>;

// The collector of the k nearest, the library's own result set, kept from image to image.
using Nearest = nanoflann::KNNResultSet<double, std::uint32_t>;
using Within = nanoflann::RadiusResultSet<double, std::uint32_t>;

const nanoflann::SearchParams unsorted(32, 0, false);

template <class Tree> class Searched : public Peer {
public:
    PeerResult nearest(const double *query, std::size_t k, bool more) override {
        if (!more) {
            ids.resize(k);
            distances.resize(k);
            set = Nearest(k);
            set.init(ids.data(), distances.data());
        }
        tree().findNeighbors(set, query, unsorted);
        return {ids.data(), set.size(), set.worstDist()};
    }

    PeerResult within(const double *query, double radius, bool more) override {
        if (!more) {
            ids.clear();
        }
        // The library's radius is open; no point lies exactly at a requested radius.
        Within inside(radius, pairs);
        tree().findNeighbors(inside, query, unsorted);
        for (const auto &pair : pairs) {
            ids.push_back(pair.first);
        }
        return {ids.data(), ids.size(), radius};
    }

protected:
    virtual const Tree &tree() const = 0;

private:
    std::vector<std::uint32_t> ids;
    std::vector<double> distances;
    std::vector<std::pair<std::uint32_t, double>> pairs;
    Nearest set{0};
};

template <int Width> class Built final : public Searched<Static<Width>> {
public:
    Built(std::size_t width, const double *rows, std::size_t n)
        : cloud{width, n, std::vector<double>(rows, rows + n * width)}, index(static_cast<int>(width), cloud) {}

    void insert(const double *) override {}

protected:
    const Static<Width> &tree() const override { return index; }

private:
    Cloud cloud;
    Static<Width> index;
};

template <int Width> class Growing final : public Searched<Dynamic<Width>> {
public:
    Growing(std::size_t width, std::size_t room)
        : cloud{width, 0, {}},
          index(static_cast<int>(width), cloud, nanoflann::KDTreeSingleIndexAdaptorParams(), room) {
        cloud.rows.reserve(room * width);
    }

    void insert(const double *row) override {
        cloud.rows.insert(cloud.rows.end(), row, row + cloud.width);
        const std::size_t at = cloud.points++;
        index.addPoints(at, at);
    }

protected:
    const Dynamic<Width> &tree() const override { return index; }

private:
    Cloud cloud;
    Dynamic<Width> index;
};

// Widths that are known at compile time make the search faster.
template <template <int> class Of, class... Arguments> Peer *make(std::size_t width, Arguments... arguments) {
    switch (width) {
    case 3:
        return new Of<3>(width, arguments...);
    case 4:
        return new Of<4>(width, arguments...);
    case 6:
        return new Of<6>(width, arguments...);
    case 12:
        return new Of<12>(width, arguments...);
    default:
        return new Of<-1>(width, arguments...);
    }
}

} // namespace

extern "C" {

Peer *nanoflann_static(std::size_t width, const double *rows, std::size_t n) { return make<Built>(width, rows, n); }

Peer *nanoflann_dynamic(std::size_t width, std::size_t room) { return make<Growing>(width, room); }
}
