// One planner with one structure of neighbours and one seed, ended by its number of vertices.
#include "clock.hpp"
#include "race.hpp"
#include "replay.hpp"
#include "spaces.hpp"

#include <algorithm>
#include <cstring>
#include <dlfcn.h>
#include <iterator>
#include <map>
#include <ompl/base/PlannerData.h>
#include <ompl/geometric/planners/prm/PRMstar.h>
#include <ompl/geometric/planners/rrt/LazyRRT.h>
#include <ompl/geometric/planners/rrt/RRT.h>
#include <ompl/geometric/planners/rrt/RRTConnect.h>
#include <ompl/geometric/planners/rrt/RRTstar.h>
#ifdef BARE
// Where the program has GNAT's functions, the library takes them too: `shipped` must not have them.
#include <ompl/datastructures/NearestNeighborsGNATNoThreadSafety.h>
#endif

namespace og = ompl::geometric;

namespace {

struct Run {
    // "gnat", "wayfold", "record" or "replay".
    std::string structure;
    std::uint_fast32_t seed;
    std::size_t vertices;
    const char *answers;
};

template <class P> constexpr bool is_roadmap = std::is_base_of_v<og::PRM, P>;
template <class P> constexpr bool is_lazy = std::is_base_of_v<og::LazyRRT, P>;

// A planner whose structure can be read.
template <class P> class Opened : public P {
public:
    using P::P;

    auto &tree() {
        if constexpr (std::is_base_of_v<og::RRTConnect, P>) {
            return this->tStart_;
        } else {
            return this->nn_;
        }
    }
    std::size_t vertices() {
        if constexpr (std::is_base_of_v<og::RRTConnect, P>) {
            return this->tStart_->size() + this->tGoal_->size();
        } else {
            return this->nn_->size();
        }
    }
    template <template <class> class Structure> void swap() {
        this->template setNearestNeighbors<Structure>();
        if constexpr (is_roadmap<P>) {
            // Its setup sets a distance only for its own structure.
            this->nn_->setDistanceFunction([this](auto a, auto b) { return this->distanceFunction(a, b); });
        }
    }
    void record() {
        auto context = wayfold::detail::context_of(this->si_);
        if constexpr (is_roadmap<P>) {
            wayfold::detail::read_vertices<og::PRM>(*this, context);
        }
        const wayfold::detail::Scope scope(context);
        this->template setNearestNeighbors<replay::Recorder>();
    }
};

// The file that has the functions of the planner's structure.
template <class Structure> std::string file_of(const Structure &structure) {
    Dl_info info{};
    dladdr(*reinterpret_cast<void *const *>(&structure), &info);
    const std::string path = info.dli_fname == nullptr ? "" : info.dli_fname;
    return path.substr(path.rfind('/') + 1);
}

template <class P> void choose(Opened<P> &planner, const Run &run) {
    if (run.structure == "wayfold") {
        wayfold::use(planner);
    } else if (run.structure == "record") {
        planner.record();
    } else if (run.structure == "replay") {
        replay::answers.read(run.answers);
        planner.template swap<replay::Replay>();
    } else {
        // Without a choice, OMPL takes the GNAT that is compiled into its library.
#ifdef BARE
        planner.template swap<ompl::NearestNeighborsGNATNoThreadSafety>();
#endif
    }
}

template <class P> int grow(Problem (*make)(), const Run &run) {
    ompl::RNG::setSeed(run.seed);
    const Problem problem = make();
    Opened<P> planner(problem.si);
    planner.setProblemDefinition(problem.definition);
    choose(planner, run);
    planner.setup();

    // LazyRRT adds a vertex in each iteration and removes some: its adds count.
    std::size_t iterations = 0;
    const ob::PlannerTerminationCondition end([&] {
        return is_lazy<P> ? iterations++ == run.vertices : planner.vertices() >= run.vertices;
    });
    const double began = own_seconds(), others_began = other_seconds();
    if constexpr (is_roadmap<P>) {
        planner.growRoadmap(end);
    } else {
        planner.solve(end);
    }
    const double own = own_seconds() - began;
    wait_for_merges();
    const double others = other_seconds() - others_began;
    if (run.structure == "record") {
        replay::answers.write(run.answers);
    } else if (replay::answers.next != replay::answers.numbers.size()) {
        std::fputs("the planner asks less than it did in the recorded run\n", stderr);
        return 1;
    }

    // The order of the vertices is the structure's, so the lengths are added in an order of their own.
    ob::PlannerData data(problem.si);
    planner.getPlannerData(data);
    std::vector<double> lengths;
    std::vector<unsigned int> to;
    for (unsigned int vertex = 0; vertex < data.numVertices(); vertex++) {
        data.getEdges(vertex, to);
        for (const unsigned int other : to) {
            lengths.push_back(
                problem.si->distance(data.getVertex(vertex).getState(), data.getVertex(other).getState()));
        }
    }
    std::sort(lengths.begin(), lengths.end());
    double length = 0;
    for (const double one : lengths) {
        length += one;
    }
    std::printf("{\"own\": %.9f, \"others\": %.9f, \"vertices\": %zu, \"edges\": %zu, \"length\": %.17g, "
                "\"answers\": %zu, \"structure\": \"%s\"}\n",
                own, others, planner.vertices(), lengths.size(), length, replay::answers.numbers.size(),
                file_of(*planner.tree()).c_str());
    return 0;
}

// True if the bare distance is OMPL's, to the bit.
template <class Space, class Ompl> bool is_equal(const Problem &problem) {
    const auto &space = *problem.si->getStateSpace();
    ob::ScopedState<> a(problem.si), b(problem.si);
    for (int round = 0; round < 1000; round++) {
        a.random();
        b.random();
        if (space.distance(a.get(), b.get()) != space.as<Space>()->Ompl::distance(a.get(), b.get())) {
            return false;
        }
    }
    return true;
}

Problem in_se3() { return se3_in(std::make_shared<SE3>()); }
Problem in_se2() { return se2_in(std::make_shared<SE2>()); }

int check_distances() {
    if (!is_equal<SE3, ob::SE3StateSpace>(in_se3()) || !is_equal<SE2, ob::SE2StateSpace>(in_se2())) {
        std::fputs("the bare distance is not OMPL's\n", stderr);
        return 1;
    }
    return 0;
}

} // namespace

int plan(int count, char **arguments) {
    if (count == 1 && std::strcmp(arguments[0], "check") == 0) {
        return check_distances();
    }
    if (count != 6) {
        std::fputs("plan PLANNER se2|se3 gnat|wayfold|record|replay SEED VERTICES ANSWERS\n", stderr);
        return 2;
    }
    const Run run{arguments[2], std::stoul(arguments[3]), std::stoul(arguments[4]), arguments[5]};
    const auto make = std::strcmp(arguments[1], "se2") == 0 ? in_se2 : in_se3;
    const std::map<std::string, int (*)(Problem (*)(), const Run &)> planners = {
        {"RRT", grow<og::RRT>},         {"RRTConnect", grow<og::RRTConnect>}, {"PRM", grow<og::PRM>},
        {"PRM*", grow<og::PRMstar>},    {"LazyRRT", grow<og::LazyRRT>},       {"RRT*", grow<og::RRTstar>},
    };
    return planners.at(arguments[0])(make, run);
}
