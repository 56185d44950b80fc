// The processor time of planners with GNAT and with Wayfold, where checks are cheap: client/cpp/race runs it.
#include "problem.hpp"

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <ompl/geometric/planners/prm/LazyPRM.h>
#include <ompl/geometric/planners/prm/PRMstar.h>
#include <ompl/geometric/planners/rrt/LazyRRT.h>
#include <ompl/geometric/planners/rrt/RRT.h>
#include <ompl/geometric/planners/rrt/RRTConnect.h>
#include <ompl/geometric/planners/rrt/RRTstar.h>
#include <ompl/datastructures/NearestNeighborsGNATNoThreadSafety.h>
#include <ompl/util/Console.h>
#include <sys/wait.h>
#include <unistd.h>
#include <vector>
#include <wayfold/ompl.hpp>

namespace og = ompl::geometric;

namespace {

double processor_seconds() {
    timespec time{};
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

// In a process of its own: OMPL takes one seed. The merges of other threads count.
template <class P> double run(Problem (*make)(), bool is_wayfold, int seed, unsigned int vertices) {
    int ends[2];
    if (pipe(ends) != 0) {
        std::exit(1);
    }
    const pid_t child = fork();
    if (child == 0) {
        ompl::RNG::setSeed(seed);
        const Problem problem = make();
        P planner(problem.si);
        planner.setProblemDefinition(problem.definition);
        if (is_wayfold) {
            wayfold::use(planner);
        } else if constexpr (!std::is_base_of_v<og::PRM, P> && !std::is_base_of_v<og::LazyPRM, P>) {
            // These two would give it no distance function; GNAT is their default.
            planner.template setNearestNeighbors<ompl::NearestNeighborsGNATNoThreadSafety>();
        }
        planner.setup();
        ob::IterationTerminationCondition counter(vertices);
        const ob::PlannerTerminationCondition after = counter;
        const double began = processor_seconds();
        if constexpr (std::is_base_of_v<og::PRM, P>) {
            planner.growRoadmap(after);
        } else {
            planner.solve(after);
        }
        const double took = processor_seconds() - began;
        _exit(write(ends[1], &took, sizeof took) == sizeof took ? 0 : 1);
    }
    close(ends[1]);
    double took = 0;
    if (read(ends[0], &took, sizeof took) != sizeof took) {
        std::exit(1);
    }
    close(ends[0]);
    waitpid(child, nullptr, 0);
    return took;
}

double median(std::vector<double> times) {
    std::sort(times.begin(), times.end());
    return times[times.size() / 2];
}

template <class P> void race(const char *name, Problem (*make)(), unsigned int iterations, int runs) {
    std::vector<double> gnat, wayfold, ratios;
    for (int seed = 1; seed <= runs; seed++) {
        gnat.push_back(run<P>(make, false, seed, iterations));
        wayfold.push_back(run<P>(make, true, seed, iterations));
        ratios.push_back(gnat.back() / wayfold.back());
    }
    const auto [least, most] = std::minmax_element(ratios.begin(), ratios.end());
    std::printf("| %s, %u iterations | %.3f s | %.3f s | %.2f | %.2f to %.2f |\n", name, iterations, median(gnat),
                median(wayfold), median(ratios), *least, *most);
    std::fflush(stdout);
}

} // namespace

int main(int count, char **arguments) {
    ompl::msg::setLogLevel(ompl::msg::LOG_ERROR);
    const int runs = count > 1 ? std::atoi(arguments[1]) : 5;
    std::printf("| planner | GNAT | Wayfold | ratio | its range over %d seeds |\n|---|---|---|---|---|\n", runs);
    race<og::RRT>("RRT, SE3", se3, 25000, runs);
    race<og::RRTConnect>("RRTConnect, SE3", se3, 12500, runs);
    race<og::PRM>("PRM, SE3", se3, 15000, runs);
    race<og::PRMstar>("PRM*, SE3", se3, 10000, runs);
    race<og::LazyRRT>("LazyRRT, SE3", se3, 25000, runs);
    race<og::RRTstar>("RRT*, SE2", se2, 10000, runs);
    race<og::RRTstar>("RRT*, SE3", se3, 5000, runs);
}
