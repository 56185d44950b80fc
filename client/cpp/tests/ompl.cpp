// ompl.hpp: conformance over OMPL's interface, the traps of its planners, and the same trees as with GNAT.
#include "check.hpp"
#include "problem.hpp"

#include <algorithm>
#include <cstring>
#include <map>
#include <ompl/base/spaces/DubinsStateSpace.h>
#include <ompl/base/spaces/ReedsSheppStateSpace.h>
#include <ompl/base/terminationconditions/IterationTerminationCondition.h>
#include <ompl/datastructures/NearestNeighborsGNATNoThreadSafety.h>
#include <ompl/datastructures/NearestNeighborsLinear.h>
#include <ompl/geometric/planners/fmt/FMT.h>
#include <ompl/geometric/planners/prm/LazyPRM.h>
#include <ompl/geometric/planners/prm/PRMstar.h>
#include <ompl/geometric/planners/rrt/LazyRRT.h>
#include <ompl/geometric/planners/rrt/RRTConnect.h>
#include <ompl/geometric/planners/rrt/RRTXstatic.h>
#include <ompl/geometric/planners/rrt/RRTstar.h>
#include <ompl/geometric/planners/rrt/TRRT.h>
#include <ompl/geometric/planners/rrt/TSRRT.h>
#include <ompl/geometric/planners/rrt/pRRT.h>
#include <ompl/geometric/planners/sst/SST.h>
#include <ompl/geometric/planners/rrt/RRT.h>
#include <ompl/util/Console.h>
#include <random>
#include <string>
#include <sys/wait.h>
#include <unistd.h>
#include <wayfold/ompl.hpp>

namespace og = ompl::geometric;

namespace {

// An element of one's own, without a hash.
struct Own {
    std::vector<double> at;
    bool operator==(const Own &other) const { return at == other.at; }
    bool operator!=(const Own &other) const { return at != other.at; }
};

// A motion as planners have it.
struct Motion {
    ob::State *state;
};

template <class T> void same(const std::vector<T> &ours, const std::vector<T> &theirs, const T &query,
                             const std::function<double(const T &, const T &)> &distance) {
    CHECK(ours.size() == theirs.size());
    for (std::size_t at = 0; at < ours.size(); at++) {
        CHECK(std::fabs(distance(query, ours[at]) - distance(query, theirs[at])) < 1e-9);
    }
}

// Adds, removes and searches at random, beside OMPL's brute force.
template <class T, class Make>
void conforms(wayfold::NearestNeighborsWayfold<T> &ours, const std::function<double(const T &, const T &)> &distance,
              Make make) {
    ompl::NearestNeighborsLinear<T> theirs;
    theirs.setDistanceFunction(distance);
    ours.setDistanceFunction(distance);
    CHECK(ours.reportsSortedResults() && ours.size() == 0);
    CHECK(!message_of<ompl::Exception>([&] { ours.nearest(make()); }).empty());
    std::vector<T> found{make()}, expected, all;
    ours.nearestK(make(), 3, found);
    CHECK(found.empty());
    std::mt19937 random(2);
    for (int round = 0; round < 3000; round++) {
        const T element = make();
        if (round % 5 == 4) {
            const T removed = all[random() % all.size()];
            CHECK(ours.remove(removed) && theirs.remove(removed));
            all.erase(std::find(all.begin(), all.end(), removed));
        } else if (round % 100 == 7) {
            const std::vector<T> two{element, make()};
            ours.add(two);
            theirs.add(two);
            all.insert(all.end(), two.begin(), two.end());
        } else {
            ours.add(element);
            theirs.add(element);
            all.push_back(element);
        }
        CHECK(ours.size() == theirs.size());
        if (round % 20 == 0) {
            const T query = make();
            CHECK(!ours.remove(query));
            same<T>({ours.nearest(query)}, {theirs.nearest(query)}, query, distance);
            for (const std::size_t k : {0UL, 1UL, 10UL, 100000UL}) {
                ours.nearestK(query, k, found);
                theirs.nearestK(query, k, expected);
                same(found, expected, query, distance);
            }
            for (const double radius : {-1.0, 0.0, 0.5, 1e9}) {
                ours.nearestR(query, radius, found);
                theirs.nearestR(query, radius, expected);
                same(found, expected, query, distance);
            }
        }
    }
    ours.list(found);
    CHECK(found.size() == all.size());
    for (const T &element : all) {
        const auto at = std::find(found.begin(), found.end(), element);
        CHECK(at != found.end());
        found.erase(at);
    }
    // An element that was added twice is removed twice.
    const T twice = make();
    ours.add(twice);
    ours.add(twice);
    CHECK(ours.remove(twice) && ours.remove(twice) && !ours.remove(twice));
    ours.clear();
    CHECK(ours.size() == 0);
    ours.add(twice);
    CHECK(ours.size() == 1 && ours.nearest(make()) == twice);
    ours.list(found);
    CHECK(found.size() == 1);
}

void conformance() {
    const auto problem = se3();
    const auto si = problem.si;
    const auto sampler = si->allocStateSampler();
    std::vector<ob::State *> states;
    const auto sample = [&] {
        states.push_back(si->allocState());
        sampler->sampleUniform(states.back());
        return states.back();
    };
    {
        wayfold::NearestNeighborsWayfold<ob::State *> ours(wayfold::detail::context_of(si));
        conforms<ob::State *>(
            ours, [&](ob::State *const &a, ob::State *const &b) { return si->distance(a, b); }, sample);
    }
    {
        std::vector<std::unique_ptr<Motion>> motions;
        wayfold::NearestNeighborsWayfold<Motion *> ours(wayfold::detail::context_of(si));
        conforms<Motion *>(
            ours, [&](Motion *const &a, Motion *const &b) { return si->distance(a->state, b->state); },
            [&] {
                motions.push_back(std::make_unique<Motion>(Motion{sample()}));
                return motions.back().get();
            });
        // A state that changes after it was stored is found where it was, and can be removed.
        ours.clear();
        for (int at = 0; at < 10; at++) {
            ours.add(motions[at].get());
        }
        for (int at = 0; at < 10; at++) {
            Motion *moved = motions[at].get(), *before = motions[10 + at].get();
            si->copyState(before->state, moved->state);
            sampler->sampleUniform(moved->state);
            std::vector<Motion *> found;
            ours.nearestR(before, 0, found);
            CHECK(ours.nearest(before) == moved && found == std::vector<Motion *>{moved});
            ours.nearestR(moved, 0, found);
            CHECK(found.empty());
            CHECK(ours.remove(moved));
        }
        CHECK(ours.size() == 0);
        // clear does not read elements: the planner has freed them.
        for (int at = 0; at < 10; at++) {
            ours.add(motions[at].get());
        }
        motions.clear();
        ours.clear();
    }
    {
        std::mt19937 random(3);
        std::uniform_real_distribution<double> uniform(-3, 3);
        wayfold::NearestNeighborsWayfold<Own> ours(
            "sum(R2, SO2:0.5)", [](const Own &own, double *row) { std::copy(own.at.begin(), own.at.end(), row); });
        conforms<Own>(
            ours,
            [](const Own &a, const Own &b) {
                const double turn = std::fabs(a.at[2] - b.at[2]);
                return std::hypot(a.at[0] - b.at[0], a.at[1] - b.at[1]) + 0.5 * std::min(turn, 2 * M_PI - turn);
            },
            [&] { return Own{{uniform(random), uniform(random), uniform(random)}}; });
    }
    for (ob::State *state : states) {
        si->freeState(state);
    }
}

// Nested compound spaces, with weights, times and integers.
void flattening() {
    auto inner = std::make_shared<ob::CompoundStateSpace>();
    inner->addSubspace(std::make_shared<ob::SO3StateSpace>(), 0.5);
    inner->addSubspace(std::make_shared<ob::DiscreteStateSpace>(0, 5), 2.0);
    auto outer = std::make_shared<ob::CompoundStateSpace>();
    auto plane = std::make_shared<ob::RealVectorStateSpace>(2);
    plane->setBounds(0, 10);
    outer->addSubspace(plane, 1.0);
    outer->addSubspace(inner, 0.25);
    auto time = std::make_shared<ob::TimeStateSpace>();
    time->setBounds(0, 3);
    outer->addSubspace(time, 1.5);
    outer->addSubspace(std::make_shared<ob::SE2StateSpace>(), 0.0);
    outer->getSubspace(3)->as<ob::SE2StateSpace>()->setBounds(box(2));
    outer->setup();
    const wayfold::OmplSpace space(outer);
    CHECK(space.text() == "sum(R2, SO3:0.125, R1:0.5, R1:1.5, R2:0, SO2:0)");
    const auto index = wayfold::Index::in_memory(space.text());
    ob::ScopedState<> a(outer), b(outer);
    for (int round = 0; round < 1000; round++) {
        a.random();
        b.random();
        std::vector<double> rows(2 * space.width());
        space.write(a.get(), rows.data());
        space.write(b.get(), rows.data() + space.width());
        const double ours = index.distance(rows.data(), rows.data() + space.width());
        CHECK(std::fabs(ours - outer->distance(a.get(), b.get())) < 1e-9);
    }
}

void refusals() {
    CHECK(message_of<ompl::Exception>([] { wayfold::NearestNeighborsWayfold<ob::State *> none; }).find("wayfold::use") !=
          std::string::npos);
    const auto dubins = std::make_shared<ob::DubinsStateSpace>();
    CHECK(message_of<ompl::Exception>([&] { wayfold::OmplSpace space(dubins); }).find("a space text") != std::string::npos);
    // Reeds–Shepp claims to be SE2.
    const auto cars = std::make_shared<ob::ReedsSheppStateSpace>();
    cars->setBounds(box(2));
    const auto si = std::make_shared<ob::SpaceInformation>(cars);
    si->setStateValidityChecker([](const ob::State *) { return true; });
    si->setup();
    const auto definition = std::make_shared<ob::ProblemDefinition>(si);
    ob::ScopedState<> start(cars), goal(cars);
    start.random();
    goal.random();
    definition->setStartAndGoalStates(start, goal);
    og::RRTstar planner(si);
    planner.setProblemDefinition(definition);
    const auto refused = message_of<ompl::Exception>([&] { wayfold::use(planner); });
    CHECK(refused.find("distance of two states") != std::string::npos);
    static_assert(!wayfold::detail::CanSwap<og::FMT>::value && !wayfold::detail::CanSwap<og::TSRRT>::value);
    static_assert(!wayfold::detail::CanSwap<ob::Planner>::value);
    static_assert(wayfold::detail::CanSwap<og::RRT>::value && wayfold::detail::CanSwap<og::SST>::value);
}

// All vertices and edges of a planner, as the bits of their states, sorted.
using Tree = std::vector<std::string>;

Tree tree_of(const ob::Planner &planner) {
    const auto si = planner.getSpaceInformation();
    ob::PlannerData data(si);
    planner.getPlannerData(data);
    const auto bits = [&](unsigned int vertex) {
        std::string text(si->getStateSpace()->getSerializationLength(), '\0');
        si->getStateSpace()->serialize(text.data(), data.getVertex(vertex).getState());
        return text;
    };
    Tree tree;
    for (unsigned int vertex = 0; vertex < data.numVertices(); vertex++) {
        std::vector<unsigned int> edges;
        data.getEdges(vertex, edges);
        tree.push_back(bits(vertex));
        for (const unsigned int to : edges) {
            tree.push_back(bits(vertex) + bits(to));
        }
    }
    std::sort(tree.begin(), tree.end());
    return tree;
}

// Runs in a process of its own: OMPL takes one seed.
template <class P, class Configure> std::string grow(Problem (*make)(), bool is_wayfold, int seed, unsigned int iterations,
                                                     Configure configure) {
    int ends[2];
    CHECK(pipe(ends) == 0);
    const pid_t child = fork();
    CHECK(child >= 0);
    if (child == 0) {
        ompl::RNG::setSeed(seed);
        const Problem problem = make();
        P planner(problem.si);
        // The tree is the same if `use` comes first, as from an allocator. OMPL's own SST needs the definition before.
        const bool is_early = !is_wayfold || seed == 1;
        if (is_early) {
            planner.setProblemDefinition(problem.definition);
        }
        configure(planner);
        if (is_wayfold) {
            wayfold::use(planner);
        } else if constexpr (!std::is_base_of_v<og::PRM, P> && !std::is_base_of_v<og::LazyPRM, P> &&
                             !std::is_base_of_v<og::TRRT, P>) {
            // PRM and LazyPRM would give it no distance function, and TRRT would read a null pointer; GNAT is their default.
            planner.template setNearestNeighbors<ompl::NearestNeighborsGNATNoThreadSafety>();
        }
        if (!is_early) {
            planner.setProblemDefinition(problem.definition);
        }
        ob::IterationTerminationCondition counter(iterations);
        const ob::PlannerTerminationCondition ends_after = counter;
        if constexpr (std::is_base_of_v<og::PRM, P>) {
            planner.setup();
            planner.growRoadmap(ends_after);
        } else {
            planner.solve(ends_after);
        }
        const Tree tree = tree_of(planner);
        std::size_t hash = 0;
        for (const std::string &part : tree) {
            hash = hash * 31 + std::hash<std::string>()(part);
        }
        const std::string line = std::to_string(tree.size()) + " " + std::to_string(hash);
        const bool is_written = write(ends[1], line.data(), line.size()) == static_cast<ssize_t>(line.size());
        planner.clear();
        _exit(is_written ? 0 : 1);
    }
    close(ends[1]);
    char line[128];
    const ssize_t bytes = read(ends[0], line, sizeof line);
    close(ends[0]);
    int status = 1;
    CHECK(waitpid(child, &status, 0) == child && status == 0 && bytes > 0);
    return std::string(line, static_cast<std::size_t>(bytes));
}

template <class P, class Configure> void same_tree(const char *name, unsigned int iterations, Configure configure) {
    for (const auto make : {se2, se3}) {
        for (const int seed : {1, 2}) {
            const auto ours = grow<P>(make, true, seed, iterations, configure);
            const auto theirs = grow<P>(make, false, seed, iterations, configure);
            std::cout << name << (make == se2 ? " SE2" : " SE3") << ", seed " << seed << ": " << ours << "\n";
            CHECK(std::stoul(ours) > 10);
            CHECK(ours == theirs);
        }
    }
}

void trees() {
    const auto plain = [](auto &) {};
    same_tree<og::RRT>("RRT", 3000, plain);
    same_tree<og::RRTConnect>("RRTConnect", 2000, plain);
    same_tree<og::PRM>("PRM", 1500, plain);
    same_tree<og::PRMstar>("PRMstar", 800, plain);
    same_tree<og::LazyPRM>("LazyPRM", 1000, plain);
    same_tree<og::RRTstar>("RRTstar", 1500, plain);
    same_tree<og::LazyRRT>("LazyRRT", 3000, plain);
    same_tree<og::SST>("SST", 2000, plain);
    same_tree<og::TRRT>("TRRT", 2000, plain);
    same_tree<og::RRTXstatic>("RRTXstatic", 300, plain);
}

// Several threads over one structure, where OMPL only has a PlannerPtr.
void threads() {
    const Problem problem = se2();
    ob::ScopedState<ob::SE2StateSpace> goal(problem.si->getStateSpace());
    goal->setXY(7, 7);
    goal->setYaw(1);
    problem.definition->setGoalState(goal, 0.5);
    const auto planner = wayfold::allocator<og::pRRT>()(problem.si);
    planner->setProblemDefinition(problem.definition);
    planner->setup();
    CHECK(planner->solve(30.0) == ob::PlannerStatus::EXACT_SOLUTION);
    CHECK(problem.definition->getSolutionPath()->check());
}

// A resolution of motion checks that is set after `use` counts, as it does without `use`, also if `use` refuses the space.
void resolution_after_use() {
    const auto length = [](const auto &act) {
        const auto space = std::make_shared<ob::SE2StateSpace>();
        space->setBounds(box(2));
        const auto si = std::make_shared<ob::SpaceInformation>(space);
        si->setStateValidityChecker([](const ob::State *) { return true; });
        og::RRTConnect planner(si);
        act(planner);
        space->setLongestValidSegmentFraction(0.0001);
        planner.setup();
        return space->getLongestValidSegmentLength();
    };
    const double plain = length([](auto &) {});
    CHECK(length([](auto &planner) { wayfold::use(planner); }) == plain);
    CHECK(length([](auto &planner) {
              const auto zeros = [](const ob::State *, double *row) { std::fill_n(row, 3, 0); };
              refuses<ompl::Exception>("distance of two states", [&] { wayfold::use(planner, "R3", zeros); });
          }) == plain);
}

} // namespace

int main() {
    ompl::msg::setLogLevel(ompl::msg::LOG_ERROR);
    // Processes are forked before threads start.
    trees();
    conformance();
    flattening();
    refusals();
    resolution_after_use();
    threads();
    std::cout << "ompl: ok\n";
}
