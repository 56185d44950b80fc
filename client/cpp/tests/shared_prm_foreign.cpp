// shared_prm.hpp: vertices of other processes that arrive together, points that are no vertices, and indices of other
// programs: shared_prm_foreign URI CLI, where CLI is the command line's program.
#include "check.hpp"
#include "roadmap.hpp"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <ompl/util/Console.h>
#include <string>
#include <utility>
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

// Little-endian, as in a payload.
std::string bytes_of(const std::vector<std::uint64_t> &ids) {
    std::string bytes;
    for (const std::uint64_t id : ids) {
        for (unsigned int byte = 0; byte < 8; byte++) {
            bytes.push_back(static_cast<char>(id >> (8 * byte)));
        }
    }
    return bytes;
}

// A payload that no roadmap has is not taken for edges.
void foreign_payloads() {
    const std::uint64_t too_large = std::uint64_t{1} << 63;
    const std::vector<std::pair<std::string, std::string>> payloads{
        {"12 bytes", std::string(12, 'a')},    {"do not ascend", bytes_of({4, 3})}, {"do not ascend", bytes_of({3, 3})},
        {"the point itself", bytes_of({3, 7})}, {"below 2^63", bytes_of({3, too_large})}};
    for (const auto &[problem, payload] : payloads) {
        const auto index = wayfold::Index::in_memory(space);
        index.insert({0.5, 0.5, 0}, 0, payload, 7);
        Planner planner(index);
        refuses<ompl::Exception>("point 7 is no vertex of a roadmap", [&] { planner.prm->refresh(); });
        refuses<ompl::Exception>(problem, [&] { planner.prm->refresh(); });
        CHECK(planner.prm->edgeCount() == 0);
        CHECK(index.remove(7));
        planner.prm->clear();
        planner.grow(20);
        CHECK(planner.prm->milestoneCount() == 20);
    }
    using wayfold::detail::edges_of, wayfold::detail::payload_of;
    CHECK(payload_of({5, 3, 5}) == bytes_of({3, 5}) && edges_of(7, payload_of({5, 3})) == std::vector<std::uint64_t>({3, 5}));
    CHECK(edges_of(7, "").empty());
}

// An index of a server that declares another encoding, or none, is refused, though its payloads decode to ids.
void foreign_declarations(const std::string &uri) {
    using wayfold::PayloadEncoding;
    // An edge to the point 1000003 with the cost 1.
    const std::string payload = bytes_of({1000003, 0x3ff0000000000000});
    for (const bool is_weighted : {false, true}) {
        const auto encoding = is_weighted ? PayloadEncoding::weighted_edges : PayloadEncoding::none;
        const std::string name = is_weighted ? "weighted" : "undeclared";
        const std::string sentence = is_weighted ? "this one declares weighted edges" : "this one declares nothing";
        const auto index = wayfold::Index::shared(uri, name, {space, encoding});
        CHECK(index.payload_encoding() == encoding);
        refuses<ompl::Exception>(sentence, [&] { Planner planner(index); });
        const std::uint64_t id = index.insert({0.5, 0.5, 0}, 0, payload);
        index.flush();
        CHECK(wayfold::detail::edges_of(id, payload).size() == 2);
        refuses<ompl::Exception>(sentence, [&] { Planner planner(index); });
    }
    // By its name, for which the planner declares edges.
    const auto si = discs::information();
    refuses<ompl::Exception>("this one declares nothing", [&] { wayfold::SharedPRM(si, uri, "undeclared"); });
    refuses<wayfold::Error>("PAYLOAD_ENCODING_WEIGHTED_EDGES, not PAYLOAD_ENCODING_EDGES",
                            [&] { wayfold::SharedPRM(si, uri, "weighted"); });
}

// An operator makes the index again, with another encoding, while a planner has it open: nothing is stored there.
void made_again(const std::string &uri, const std::string &cli) {
    const auto run = [&](const std::string &words) {
        CHECK(std::system(("'" + cli + "' --server " + uri + " " + words + " > /dev/null").c_str()) == 0);
    };
    Planner planner(wayfold::Index::shared(uri, "again", roadmap::new_index));
    planner.grow(10);
    planner.prm->flush();
    run("delete again");
    run("create again --space '" + space + "' --payloads weighted-edges");
    const auto &index = planner.prm->index();
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(60);
    while (index.payload_encoding() != wayfold::PayloadEncoding::weighted_edges) {
        CHECK(std::chrono::steady_clock::now() < end);
    }
    for (int round = 0; round < 2; round++) {
        refuses<ompl::Exception>("this one declares weighted edges", [&] { planner.grow(1); });
        planner.prm->clear();
    }
    CHECK(index.empty());
}

} // namespace

int main(int count, char **arguments) {
    CHECK(count == 3);
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    arrivals_together();
    foreign_payloads();
    foreign_declarations(arguments[1]);
    made_again(arguments[1], arguments[2]);
    std::cout << "shared_prm_foreign: ok\n";
}
