// ompl_neighbors.hpp: rotations that OMPL calls equal, and elements with types of their own.
#include "check.hpp"
#include "problem.hpp"

#include <cmath>
#include <functional>
#include <memory>
#include <new>
#include <ompl/base/spaces/SO3StateSpace.h>
#include <ompl/base/spaces/WrapperStateSpace.h>
#include <ompl/geometric/planners/prm/PRM.h>
#include <ompl/geometric/planners/rrt/RRT.h>
#include <ompl/util/Console.h>
#include <stdexcept>
#include <string>
#include <vector>
#include <wayfold/ompl.hpp>
#include <wayfold/shared_prm.hpp>

namespace {

using SO3 = ob::SO3StateSpace::StateType;

class Wrapper : public ob::WrapperStateSpace {
public:
    using WrapperStateSpace::WrapperStateSpace;
};

ob::SpaceInformationPtr information(const ob::StateSpacePtr &space) {
    const auto si = std::make_shared<ob::SpaceInformation>(space);
    si->setStateValidityChecker([](const ob::State *) { return true; });
    si->setup();
    return si;
}

ob::StateSpacePtr weighted_se3(double weight) {
    const auto space = std::make_shared<ob::SE3StateSpace>();
    space->setBounds(box(3));
    space->setSubspaceWeight(1, weight);
    return space;
}

// OMPL calls rotations less than 8.9e-5 rad apart equal, and the check of the distance lets that pass.
void near_rotations() {
    const auto space = std::make_shared<ob::SO3StateSpace>();
    const auto si = information(space);
    wayfold::NearestNeighborsWayfold<ob::State *> ours(wayfold::detail::context_of(si));
    std::vector<ob::State *> states;
    for (int at = 0; at < 10; at++) {
        states.push_back(si->allocState());
        states.back()->as<SO3>()->setAxisAngle(0, 0, 1, 1e-5 * at);
        ours.add(states.back());
    }
    CHECK(space->distance(states[0], states[1]) == 0);
    for (std::size_t at = 0; at < states.size(); at++) {
        CHECK(ours.nearest(states[at]) == states[at] && (at == 0 || si->equalStates(states[at - 1], states[at])));
    }
    for (ob::State *state : states) {
        si->freeState(state);
    }
}

// `set` makes two states whose rotations OMPL calls equal: `ours` is Wayfold's distance of them, and `theirs` is OMPL's.
template <class Set> void passes(const ob::StateSpacePtr &space, double ours, double theirs, Set set) {
    const auto si = information(space);
    const auto context = wayfold::detail::context_of(si);
    wayfold::NearestNeighborsWayfold<ob::State *> neighbors(context), more(context);
    ob::State *states[] = {si->allocState(), si->allocState()};
    for (int at = 0; at < 2; at++) {
        set(states[at], 8.8e-5 * at);
        neighbors.add(states[at]);
    }
    std::vector<double> rows(2 * context.space->width());
    context.write(states[0], rows.data());
    context.write(states[1], rows.data() + context.space->width());
    const auto index = wayfold::Index::in_memory(context.text);
    CHECK(std::fabs(index.distance(rows.data(), rows.data() + context.space->width()) - ours) < 1e-9);
    CHECK(std::fabs(si->distance(states[0], states[1]) - theirs) < 1e-9);
    // The tolerance is no more than that of the rotations.
    more.setDistanceFunction([&](ob::State *const &a, ob::State *const &b) { return si->distance(a, b) - 2e-4; });
    more.add(states[0]);
    refuses<ompl::Exception>("distance of two states", [&] { more.add(states[1]); });
    for (ob::State *state : states) {
        si->freeState(state);
    }
}

// In a compound space, the difference has the weights of all rotations.
void near_rotations_with_weights() {
    passes(weighted_se3(10), 5 + 4.4e-4, 5, [](ob::State *state, double turn) {
        state->as<ob::SE3StateSpace::StateType>()->setXYZ(turn > 0 ? 5 : 0, 0, 0);
        state->as<ob::SE3StateSpace::StateType>()->rotation().setAxisAngle(0, 0, 1, turn);
    });
    const auto inner = std::make_shared<ob::CompoundStateSpace>(), outer = std::make_shared<ob::CompoundStateSpace>();
    for (int at = 0; at < 3; at++) {
        inner->addSubspace(std::make_shared<Wrapper>(std::make_shared<ob::SO3StateSpace>()), 0.5);
    }
    outer->addSubspace(inner, 4);
    outer->addSubspace(std::make_shared<ob::SO3StateSpace>(), 1);
    passes(outer, 7 * 4.4e-5, 0, [](ob::State *state, double turn) {
        auto *parts = state->as<ob::CompoundState>();
        for (unsigned int at = 0; at < 3; at++) {
            parts->as<ob::CompoundState>(0)->as<Wrapper::StateType>(at)->getState()->as<SO3>()->setAxisAngle(0, 0, 1, turn);
        }
        parts->as<SO3>(1)->setAxisAngle(0, 0, 1, turn);
    });
}

// A start and a goal whose rotations OMPL calls equal.
ob::ProblemDefinitionPtr near_problem(const ob::SpaceInformationPtr &si) {
    ob::ScopedState<ob::SE3StateSpace> start(si->getStateSpace()), goal(si->getStateSpace());
    start->setXYZ(1, 1, 1);
    start->rotation().setIdentity();
    goal->setXYZ(6, 1, 1);
    goal->rotation().setAxisAngle(0, 0, 1, 8e-5);
    const auto definition = std::make_shared<ob::ProblemDefinition>(si);
    definition->setStartAndGoalStates(start, goal);
    return definition;
}

// A planner with a space text takes the weights from its space, as a roadmap does.
void near_rotations_in_planners() {
    const auto si = information(weighted_se3(10));
    const auto definition = near_problem(si);
    const wayfold::OmplSpace rows(si->getStateSpace());
    const wayfold::StateToRow write = [&](const ob::State *state, double *row) { rows.write(state, row); };
    const wayfold::RowToState read = [&](const double *row, ob::State *state) { rows.read(row, state); };
    ompl::geometric::PRM plain(si);
    wayfold::use(plain, rows.text(), write);
    const auto index = wayfold::Index::in_memory(rows.text());
    wayfold::SharedPRM shared(si, index, write, read);
    for (ob::Planner *planner : {static_cast<ob::Planner *>(&plain), static_cast<ob::Planner *>(&shared)}) {
        definition->clearSolutionPaths();
        planner->setProblemDefinition(definition);
        CHECK(planner->solve(60.0) == ob::PlannerStatus::EXACT_SOLUTION);
    }
}

// An element that was removed is not held any more.
void removed_elements() {
    wayfold::NearestNeighborsWayfold<std::shared_ptr<double>> neighbors(
        "R1", [](const std::shared_ptr<double> &number, double *row) { *row = *number; });
    auto first = std::make_shared<double>(1);
    const auto second = std::make_shared<double>(2);
    const std::weak_ptr<double> held = first;
    neighbors.add({first, second, first});
    CHECK(neighbors.remove(first) && neighbors.remove(first) && !neighbors.remove(first));
    first.reset();
    std::vector<std::shared_ptr<double>> left;
    neighbors.list(left);
    CHECK(held.expired() && left == std::vector<std::shared_ptr<double>>{second} && neighbors.nearest(second) == second);
}


// The copies that may still be made before one of them fails; none fails below 0.
int copies_left = -1;

struct Fragile {
    explicit Fragile(double at = 0) : at(at) {}
    Fragile(const Fragile &other) : at(other.at) {
        if (copies_left >= 0 && copies_left-- == 0) {
            throw std::bad_alloc();
        }
    }
    Fragile(Fragile &&other) noexcept : at(other.at) {}
    Fragile &operator=(const Fragile &) = default;
    Fragile &operator=(Fragile &&) = default;
    bool operator==(const Fragile &other) const { return at == other.at; }
    double at;
};

struct Hashed : Fragile {
    using Fragile::Fragile;
};

} // namespace

template <> struct std::hash<Hashed> {
    std::size_t operator()(const Hashed &element) const { return std::hash<double>()(element.at); }
};

namespace {

// An add that throws stores nothing, and the elements after it are found where they are. A remove that throws while it makes
// its table leaves none of it.
template <class T> void exceptions() {
    wayfold::NearestNeighborsWayfold<T> neighbors("R1", [](const T &element, double *row) { *row = element.at; });
    const auto holds = [&](const std::vector<double> &expected) {
        std::vector<T> found;
        neighbors.list(found);
        CHECK(neighbors.size() == expected.size() && found.size() == expected.size());
        for (std::size_t at = 0; at < expected.size(); at++) {
            CHECK(found[at].at == expected[at] && neighbors.nearest(T(expected[at])).at == expected[at]);
        }
    };
    const auto fails = [](int copies, auto action) {
        bool has_thrown = false;
        copies_left = copies;
        try {
            action();
        } catch (const std::bad_alloc &) {
            has_thrown = true;
        }
        copies_left = -1;
        return has_thrown;
    };
    for (int at = 0; at < 4; at++) {
        neighbors.add(T(at));
    }
    const T nine(9), ten(10);
    CHECK(fails(0, [&] { neighbors.add(nine); }));
    holds({0, 1, 2, 3});
    CHECK(!message_of<wayfold::Error>([&] { neighbors.add(T(std::nan(""))); }).empty());
    neighbors.add(ten);
    holds({0, 1, 2, 3, 10});
    // The table of elements is made by a remove, and takes a copy of each.
    CHECK(fails(2, [&] { neighbors.remove(ten); }) == wayfold::detail::IsHashable<T>::value);
    CHECK(neighbors.remove(T(1)) && !neighbors.remove(T(1)));
    // With the table, an add makes two copies.
    CHECK(fails(0, [&] { neighbors.add(nine); }));
    CHECK(fails(1, [&] { neighbors.add(nine); }) == wayfold::detail::IsHashable<T>::value);
    neighbors.remove(nine);
    CHECK(!message_of<wayfold::Error>([&] { neighbors.add(T(std::nan(""))); }).empty());
    neighbors.add(T(11));
    CHECK(neighbors.remove(T(2)) && !neighbors.remove(T(2)) && !neighbors.remove(nine));
    neighbors.remove(ten);
    holds({0, 3, 11});
    CHECK(neighbors.remove(T(11)) && neighbors.size() == 2);
}

// A planner whose swap fails has the problem that it had, and is as little set up.
void a_swap_that_fails() {
    class Failing : public ompl::geometric::RRT {
    public:
        using RRT::RRT;
        void setup() override {
            RRT::setup();
            throw std::runtime_error("the planner's own");
        }
    };
    const auto problem = se3();
    Failing planner(problem.si);
    for (const auto &definition : {ob::ProblemDefinitionPtr(), problem.definition}) {
        planner.setProblemDefinition(definition);
        refuses<std::runtime_error>("the planner's own", [&] { wayfold::use(planner); });
        CHECK(planner.getProblemDefinition() == definition && !planner.isSetup());
    }
}

} // namespace

int main() {
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    near_rotations();
    near_rotations_with_weights();
    near_rotations_in_planners();
    removed_elements();
    a_swap_that_fails();
    exceptions<Fragile>();
    exceptions<Hashed>();
    std::cout << "neighbors: ok\n";
}
