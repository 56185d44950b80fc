// The roadmap of a `wayfold::SharedPRM` among the discs: as text, checked, and compared with those of other processes.
#pragma once

#include "check.hpp"
#include "discs.hpp"

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <memory>
#include <ompl/base/terminationconditions/IterationTerminationCondition.h>
#include <set>
#include <string>
#include <utility>
#include <wayfold/ompl.hpp>
#include <wayfold/shared_prm.hpp>

namespace roadmap {

namespace ob = ompl::base;
namespace og = ompl::geometric;

inline const std::string space = "sum(R2, SO2:0.5)";
// The roadmap's index, if it is missing.
inline const wayfold::NewIndex new_index{space, wayfold::PayloadEncoding::edges};

struct Planner {
    explicit Planner(const wayfold::Index &index, bool star = false)
        : si(discs::information()), prm(std::make_shared<wayfold::SharedPRM>(si, index, star)) {
        prm->setProblemDefinition(discs::problem(si));
        prm->setup();
    }

    void grow(unsigned int iterations) {
        ob::IterationTerminationCondition counter(2 * iterations);
        prm->growRoadmap(ob::PlannerTerminationCondition(counter));
    }

    std::shared_ptr<ob::SpaceInformation> si;
    std::shared_ptr<wayfold::SharedPRM> prm;
};

// Names a vertex: by its id, or by its number if it has none.
template <class Prm> std::string name_of(const Prm &prm, og::PRM::Vertex vertex) {
    if constexpr (std::is_same_v<Prm, wayfold::SharedPRM>) {
        return prm.id(vertex) ? std::to_string(*prm.id(vertex)) : "";
    } else {
        return std::to_string(vertex);
    }
}

// The vertices with their states and the edges, sorted; those of start and goal states are left out.
template <class Prm> std::string graph_of(const Prm &prm) {
    const og::PRM::Graph &graph = prm.getRoadmap();
    const auto states = boost::get(og::PRM::vertex_state_t(), graph);
    std::multiset<std::string> lines;
    for (std::size_t vertex = 0; vertex < boost::num_vertices(graph); vertex++) {
        const auto &pose = *states[vertex]->template as<discs::Pose>();
        char line[128];
        std::snprintf(line, sizeof line, "vertex %s: %.17g %.17g %.17g", name_of(prm, vertex).c_str(), pose.getX(),
                      pose.getY(), pose.getYaw());
        if (!name_of(prm, vertex).empty()) {
            lines.insert(line);
        }
    }
    for (auto [edge, end] = boost::edges(graph); edge != end; ++edge) {
        std::string a = name_of(prm, boost::source(*edge, graph)), b = name_of(prm, boost::target(*edge, graph));
        if (!a.empty() && !b.empty()) {
            lines.insert("edge " + std::min(a, b) + " " + std::max(a, b));
        }
    }
    std::string text;
    for (const std::string &line : lines) {
        text += line + "\n";
    }
    return text;
}

inline std::size_t count(const std::string &graph, const std::string &kind) {
    std::size_t count = 0;
    for (std::size_t at = graph.find(kind); at != std::string::npos; at = graph.find(kind, at + 1)) {
        count++;
    }
    return count;
}

// Every vertex and every edge of a graph is free, by a check of this program's own; no edge is there twice.
inline void is_valid(const wayfold::SharedPRM &prm) {
    const og::PRM::Graph &graph = prm.getRoadmap();
    const auto states = boost::get(og::PRM::vertex_state_t(), graph);
    std::set<std::pair<og::PRM::Vertex, og::PRM::Vertex>> edges;
    for (auto [edge, end] = boost::edges(graph); edge != end; ++edge) {
        const auto from = boost::source(*edge, graph), to = boost::target(*edge, graph);
        CHECK(discs::clearance(*states[from]->as<discs::Pose>(), *states[to]->as<discs::Pose>()) > 0);
        CHECK(from != to && edges.insert(std::minmax(from, to)).second);
    }
    for (std::size_t vertex = 0; vertex < boost::num_vertices(graph); vertex++) {
        CHECK(discs::clearance(*states[vertex]->as<discs::Pose>(), *states[vertex]->as<discs::Pose>()) > 0);
    }
}

// Takes over what others have stored until the graph has this many vertices and edges.
inline void catch_up(wayfold::SharedPRM &prm, std::size_t vertices, std::size_t edges) {
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(60);
    while (prm.milestoneCount() < vertices || prm.edgeCount() < edges) {
        CHECK(std::chrono::steady_clock::now() < end);
        prm.refresh();
    }
}

} // namespace roadmap
