// Calls that several threads may make at once, for the thread sanitizer, which sees the C++ code and not the libraries:
//
//     threads URI     an index, and SharedPRM
//     threads prrt    pRRT; the sanitizer must see the lock that OMPL's library takes for it (client/cpp/check)
#include "check.hpp"
#include "discs.hpp"

#include <atomic>
#include <ompl/geometric/planners/rrt/pRRT.h>
#include <ompl/util/Console.h>
#include <random>
#include <string>
#include <thread>
#include <vector>
#include <wayfold/ompl.hpp>
#include <wayfold/shared_prm.hpp>

namespace ob = ompl::base;
namespace og = ompl::geometric;

namespace {

const std::string space = "sum(R2, SO2:0.5)";

// Inserts, removals, searches and errors of one index, on four threads.
void one_index(const wayfold::Index &index) {
    constexpr unsigned int rounds = 300;
    const std::uint64_t before = index.changes(~0ULL)->read_revision;
    std::vector<std::thread> threads;
    std::atomic<std::size_t> removed{0};
    for (unsigned int number = 0; number < 4; number++) {
        threads.emplace_back([&, number] {
            std::mt19937 random(number);
            std::uniform_real_distribution<double> uniform(-3, 3);
            std::vector<std::uint64_t> ids, near;
            for (unsigned int round = 0; round < rounds; round++) {
                const std::vector<double> row{uniform(random), uniform(random), uniform(random)};
                ids.push_back(index.insert(row.data(), number, "payload", wayfold::Search::k(3), 3, near));
                CHECK(index.nearest(row)->distance == 0 && index.nearest_k(row, 5).size() <= 5);
                CHECK(index.payloads({ids.back()})[0] == "payload");
                CHECK(!message_of<wayfold::Error>([&] { index.insert({1, 2}); }).empty());
                if (round % 3 == 0) {
                    removed += index.remove(ids[random() % ids.size()]);
                }
            }
            CHECK(index.changes(before)->stored.size() <= 4 * rounds);
        });
    }
    for (std::thread &thread : threads) {
        thread.join();
    }
    CHECK(index.size() == 4 * rounds - removed);
}

// Searches of one structure, on four threads.
void one_structure() {
    const auto number = [](const double &element, double *row) { *row = element; };
    wayfold::NearestNeighborsWayfold<double> neighbors("R1", number);
    for (int element = 0; element < 1000; element++) {
        neighbors.add(element);
    }
    std::vector<std::thread> threads;
    for (int first = 0; first < 4; first++) {
        threads.emplace_back([&neighbors, first] {
            std::vector<double> found;
            for (int element = first; element < 1000; element += 4) {
                neighbors.nearestK(element, 1, found);
                CHECK(found == std::vector<double>{double(element)} && neighbors.nearest(element) == element);
            }
        });
    }
    for (std::thread &thread : threads) {
        thread.join();
    }
}

// PRM's two threads, the thread that reads payloads, and another planner on the same roadmap.
void two_planners(const std::string &uri) {
    std::vector<std::thread> threads;
    for (int number = 0; number < 2; number++) {
        threads.emplace_back([&] {
            const auto si = discs::information();
            wayfold::SharedPRM planner(si, uri, "threads-prm");
            planner.setProblemDefinition(discs::problem(si));
            planner.growRoadmap(0.3);
            CHECK(planner.solve(ob::timedPlannerTerminationCondition(60)) == ob::PlannerStatus::EXACT_SOLUTION);
            planner.flush();
        });
    }
    for (std::thread &thread : threads) {
        thread.join();
    }
}

// pRRT's threads take turns at the neighbours, and share what the adapter holds.
void prrt() {
    const auto si = discs::information();
    og::pRRT planner(si);
    wayfold::use(planner);
    planner.setThreadCount(4);
    planner.setRange(0.3);
    planner.setProblemDefinition(discs::problem(si));
    CHECK(planner.solve(ob::timedPlannerTerminationCondition(60)) == ob::PlannerStatus::EXACT_SOLUTION);
}

} // namespace

int main(int count, char **arguments) {
    CHECK(count == 2);
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    if (arguments[1] == std::string("prrt")) {
        prrt();
        std::cout << "threads: pRRT ok\n";
        return 0;
    }
    one_structure();
    one_index(wayfold::Index::in_memory(space));
    one_index(wayfold::Index::shared(arguments[1], "threads", space));
    two_planners(arguments[1]);
    std::cout << "threads: ok\n";
}
