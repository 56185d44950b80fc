// shared_prm.hpp: vertices of other processes that arrive together, and points that are no vertices.
#include "check.hpp"
#include "roadmap.hpp"

#include <iostream>
#include <ompl/util/Console.h>
#include <string>
#include <vector>

using roadmap::Planner;
using roadmap::space;

namespace {

namespace og = ompl::geometric;

// Start and goal states get edges to vertices that arrive together, also if these are more than a vertex has neighbours.
void arrivals_together() {
    for (const unsigned int k : {1u, 3u, 10u}) {
        for (const unsigned int arriving : {1u, 2u, 12u, 40u}) {
            const auto index = wayfold::Index::in_memory(space);
            Planner planner(index);
            planner.si->setMotionValidator(std::make_shared<discs::AllMotions>(planner.si));
            planner.prm->setMaxNearestNeighbors(k);
            planner.prm->solve(roadmap::ob::PlannerTerminationCondition([] { return true; }));
            CHECK(planner.prm->milestoneCount() == 2);
            for (unsigned int at = 0; at < arriving; at++) {
                index.insert({1 + 0.01 * at, 0.5, 0}, 0);
            }
            planner.prm->refresh();
            // A search finds a query beside the k nearest vertices.
            const og::PRM::Graph &graph = planner.prm->getRoadmap();
            const std::size_t least = std::min(k, arriving);
            for (const og::PRM::Vertex query : {0, 1}) {
                CHECK(!planner.prm->id(query));
                const std::size_t edges = boost::out_degree(query, graph);
                CHECK(edges >= least && edges <= arriving + 1);
            }
        }
    }
}

} // namespace

int main() {
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    arrivals_together();
    std::cout << "shared_prm_foreign: ok\n";
}
