// The graph of wayfold/shared_prm.hpp, which includes it: the vertices by their ids, and the edges that this process has
// checked or taken over.
#pragma once

#include <wayfold/shared_prm_parts.hpp>

#include <cstddef>
#include <cstdint>
#include <set>
#include <unordered_map>
#include <utility>
#include <vector>

namespace wayfold::detail {

// All functions run with the lock of PRM's graph.
class RoadmapGraph : public ompl::geometric::PRM {
protected:
    static constexpr std::uint64_t no_id = ~std::uint64_t{0};

    RoadmapGraph(const ompl::base::SpaceInformationPtr &si, bool star) : PRM(si, star) {}

    bool is_query(Vertex vertex) const { return ids_[vertex] == no_id; }

    // Records the edges that PRM has added since the last call, each with an own vertex at its end, and returns the ends
    // of those of a vertex that is not stored yet. Edges to start and goal states are of this process alone.
    std::vector<std::uint64_t> take_edges(Vertex fresh) {
        // A checker that throws leaves a vertex that PRM adds to no neighbours. It is of this process alone too.
        ids_.resize(boost::num_vertices(g_), no_id);
        std::vector<std::uint64_t> of_fresh;
        // Boost keeps the edges of an undirected graph in the order of their making.
        auto edge = boost::edges(g_).second;
        for (std::size_t left = boost::num_edges(g_) - known_edges_; left > 0; left--) {
            --edge;
            const Vertex a = boost::source(*edge, g_), b = boost::target(*edge, g_);
            const std::uint64_t other = ids_[a == fresh ? b : a];
            if (a != fresh && b != fresh) {
                record(a, b);
            } else if (other != no_id) {
                of_fresh.push_back(other);
            }
        }
        known_edges_ = boost::num_edges(g_);
        return of_fresh;
    }

    void record(Vertex a, Vertex b) {
        auto own = own_edges_.find(ids_[a]);
        if (own == own_edges_.end()) {
            std::swap(a, b);
            own = own_edges_.find(ids_[a]);
        }
        if (own != own_edges_.end() && ids_[b] != no_id) {
            own->second.push_back(ids_[b]);
            changed_.insert(ids_[a]);
        }
    }

    // An edge that another process has checked. A payload may be newer than the copy, and name a vertex that is to come.
    void link(std::uint64_t from, std::uint64_t to) {
        const auto other = vertices_.find(to);
        if (other == vertices_.end()) {
            missing_[to].push_back(from);
        } else if (!boost::edge(vertices_.at(from), other->second, g_).second) {
            totalConnectionAttemptsProperty_[vertices_.at(from)]++;
            totalConnectionAttemptsProperty_[other->second]++;
            connect(vertices_.at(from), other->second);
        }
    }

    void connect(Vertex vertex, Vertex other) {
        successfulConnectionAttemptsProperty_[vertex]++;
        successfulConnectionAttemptsProperty_[other]++;
        const Graph::edge_property_type weight(opt_->motionCost(stateProperty_[other], stateProperty_[vertex]));
        boost::add_edge(other, vertex, weight, g_);
        uniteComponents(other, vertex);
    }

    // Tries a motion as PRM does; true if it is valid.
    bool try_motion(Vertex vertex, Vertex other) {
        if (boost::edge(vertex, other, g_).second || !connectionFilter_(other, vertex)) {
            return false;
        }
        totalConnectionAttemptsProperty_[vertex]++;
        totalConnectionAttemptsProperty_[other]++;
        const bool is_valid = si_->checkMotion(stateProperty_[other], stateProperty_[vertex]);
        if (is_valid) {
            connect(vertex, other);
        }
        known_edges_ = boost::num_edges(g_);
        return is_valid;
    }

    // By vertex; `no_id` if the index does not have it.
    std::vector<std::uint64_t> ids_;
    std::unordered_map<std::uint64_t, Vertex> vertices_;
    // The payloads of the vertices that this process has stored, and those of them that are to be written again.
    std::unordered_map<std::uint64_t, std::vector<std::uint64_t>> own_edges_;
    std::set<std::uint64_t> changed_;
    // The edges whose other ends are to come, by these.
    std::unordered_map<std::uint64_t, std::vector<std::uint64_t>> missing_;
    // The edges of the graph up to this number are in the records.
    std::size_t known_edges_{0};
};

} // namespace wayfold::detail
