// The traps of OMPL: spaces behind wrappers, spaces of one's own, distances that are not ours, and checkers that throw.
#include "check.hpp"
#include "problem.hpp"
#include "roadmap.hpp"

#include <clocale>
#include <cmath>
#include <locale>
#include <memory>
#include <ompl/base/spaces/DiscreteStateSpace.h>
#include <ompl/base/spaces/RealVectorStateSpace.h>
#include <ompl/base/spaces/TimeStateSpace.h>
#include <ompl/base/spaces/WrapperStateSpace.h>
#include <ompl/base/spaces/constraint/ProjectedStateSpace.h>
#include <ompl/base/ConstrainedSpaceInformation.h>
#include <ompl/base/objectives/PathLengthOptimizationObjective.h>
#include <ompl/control/planners/rrt/RRT.h>
#include <ompl/control/spaces/RealVectorControlSpace.h>
#include <ompl/geometric/planners/prm/LazyPRM.h>
#include <ompl/geometric/planners/prm/PRM.h>
#include <ompl/geometric/planners/rrt/BiTRRT.h>
#include <ompl/geometric/planners/rrt/RRT.h>
#include <ompl/geometric/planners/rrt/RRTConnect.h>
#include <ompl/geometric/planners/rrt/TRRT.h>
#include <ompl/geometric/planners/rrt/pRRT.h>
#include <ompl/util/Console.h>
#include <set>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>
#include <wayfold/ompl.hpp>

namespace oc = ompl::control;
namespace og = ompl::geometric;

namespace {

// A space of one's own, in a wrapper of OMPL.
class Wrapper : public ob::WrapperStateSpace {
public:
    using WrapperStateSpace::WrapperStateSpace;
};

// Wrappers within a compound space within a wrapper: rows have the numbers of the innermost states, in order, and set a
// state to them again. OMPL itself bears no wrapped compound space within another.
void wrappers() {
    auto position = std::make_shared<ob::RealVectorStateSpace>(3);
    position->setBounds(box(3));
    auto time = std::make_shared<ob::TimeStateSpace>();
    time->setBounds(0, 3);
    auto compound = std::make_shared<ob::CompoundStateSpace>();
    compound->addSubspace(std::make_shared<Wrapper>(position), 0.5);
    compound->addSubspace(std::make_shared<Wrapper>(std::make_shared<ob::SO3StateSpace>()), 0.5);
    compound->addSubspace(time, 2);
    compound->addSubspace(std::make_shared<Wrapper>(std::make_shared<ob::DiscreteStateSpace>(0, 5)), 1);
    compound->addSubspace(std::make_shared<ob::SO2StateSpace>(), 1);
    const auto outer = std::make_shared<Wrapper>(compound);
    outer->setup();
    const wayfold::OmplSpace space(outer);
    CHECK(space.text() == "sum(R3:0.5, SO3:0.5, R1:2, R1, SO2)" && space.width() == 10);
    const auto index = wayfold::Index::in_memory(space.text());
    ob::State *a = outer->allocState(), *b = outer->allocState();
    const auto sampler = outer->allocStateSampler();
    std::vector<double> row(space.width()), other(space.width());
    for (int round = 0; round < 1000; round++) {
        sampler->sampleUniform(a);
        sampler->sampleUniform(b);
        space.write(a, row.data());
        space.write(b, other.data());
        CHECK(std::fabs(index.distance(row.data(), other.data()) - outer->distance(a, b)) < 1e-9);
        space.read(row.data(), b);
        space.write(b, other.data());
        CHECK(row == other && outer->equalStates(a, b));
    }
    outer->freeState(a);
    outer->freeState(b);
}

// In a process with a decimal comma, a space text has decimal points.
void decimal_comma() {
    std::locale::global(std::locale("de_DE.UTF-8"));
    CHECK(std::string(std::localeconv()->decimal_point) == ",");
    CHECK(wayfold::OmplSpace(std::make_shared<ob::SE2StateSpace>()).text() == "sum(R2, SO2:0.5)");
    std::locale::global(std::locale::classic());
}

// Joints whose distances add up, as in MoveIt.
class Joints : public ob::RealVectorStateSpace {
public:
    Joints() : RealVectorStateSpace(3) { setBounds(0, 10); }
    double distance(const ob::State *a, const ob::State *b) const override {
        double sum = 0;
        for (unsigned int at = 0; at < 3; at++) {
            sum += std::fabs(a->as<StateType>()->values[at] - b->as<StateType>()->values[at]);
        }
        return sum;
    }
};

// Gears whose distance is not that of their numbers.
class Gears : public ob::DiscreteStateSpace {
public:
    Gears() : DiscreteStateSpace(3, 9) {}
    double distance(const ob::State *a, const ob::State *b) const override {
        return equalStates(a, b) ? 0 : 1;
    }
};

// A time whose distance is not that of its numbers.
class Later : public ob::TimeStateSpace {
public:
    Later() { setBounds(500, 510); }
    double distance(const ob::State *a, const ob::State *b) const override { return 2 * TimeStateSpace::distance(a, b); }
};

// Joints whose states have neither reals nor a serialized form: new ones are not set.
class Opaque : public Joints {
public:
    ob::State *allocState() const override {
        ob::State *state = Joints::allocState();
        std::fill_n(state->as<StateType>()->values, 3, std::nan(""));
        return state;
    }
    double *getValueAddressAtIndex(ob::State *, unsigned int) const override { return nullptr; }
    unsigned int getSerializationLength() const override { return 0; }
    void serialize(void *, const ob::State *) const override {}
    void deserialize(ob::State *, const void *) const override {}
};

// A space in which no state reaches another.
class Unreachable : public Joints {
public:
    double distance(const ob::State *, const ob::State *) const override { return HUGE_VAL; }
};

// The problem of a planner that has to reach the other end of the space.
ob::ProblemDefinitionPtr problem(const std::shared_ptr<Joints> &space = std::make_shared<Joints>()) {
    const auto si = std::make_shared<ob::SpaceInformation>(space);
    si->setStateValidityChecker([](const ob::State *state) {
        const double *values = state->as<Joints::StateType>()->values;
        return std::fabs(values[0] - 5) > 0.5 || values[1] < 5;
    });
    si->setup();
    ob::ScopedState<Joints> start(space), goal(space);
    start->values[0] = start->values[1] = start->values[2] = 9;
    goal->values[0] = goal->values[1] = 1;
    goal->values[2] = 9;
    const auto definition = std::make_shared<ob::ProblemDefinition>(si);
    definition->setStartAndGoalStates(start, goal, 0.5);
    return definition;
}

void solve(ob::Planner &planner, const ob::ProblemDefinitionPtr &definition) {
    planner.setProblemDefinition(definition);
    CHECK(planner.solve(60.0) == ob::PlannerStatus::EXACT_SOLUTION);
    CHECK(definition->getSolutionPath()->check());
}

template <class P, class Use> void plan(Use use, const std::shared_ptr<Joints> &space = std::make_shared<Joints>()) {
    const auto definition = problem(space);
    P planner(definition->getSpaceInformation());
    use(planner);
    solve(planner, definition);
}

void write(const ob::State *state, double *row) { std::copy_n(state->as<Joints::StateType>()->values, 3, row); }

// An objective that tells that a planner asked it.
class Counted : public ob::PathLengthOptimizationObjective {
public:
    using PathLengthOptimizationObjective::PathLengthOptimizationObjective;
    ob::Cost stateCost(const ob::State *) const override {
        calls++;
        return ob::Cost(1);
    }
    mutable unsigned int calls{0};
};

// Planners that read the objective in their setup get the problem after `use`, as from an allocator.
template <class P> void objectives() {
    const auto definition = problem();
    const auto objective = std::make_shared<Counted>(definition->getSpaceInformation());
    definition->setOptimizationObjective(objective);
    const auto planner = wayfold::allocator<P>("sum(R1^3)", write)(definition->getSpaceInformation());
    solve(*planner, definition);
    CHECK(objective->calls > 0);
}

// Planners with threads: the refusal comes from `use`, in the thread of its caller. Their own structure stays.
template <class P> void refused_at_once() {
    const auto definition = problem();
    P planner(definition->getSpaceInformation());
    const auto plain = message_of<ompl::Exception>([&] { wayfold::use(planner); });
    CHECK(plain.find("distance of two states") != std::string::npos);
    const auto text = message_of<ompl::Exception>([&] { wayfold::use(planner, "R3", write); });
    CHECK(text.find("distance of two states") != std::string::npos);
    CHECK(!message_of<ompl::Exception>([&] { wayfold::allocator<P>()(definition->getSpaceInformation()); }).empty());
    solve(planner, definition);
}

void spaces_of_ones_own() {
    const auto with_text = [&](auto &planner) { wayfold::use(planner, "sum(R1^3)", write); };
    plan<og::RRTConnect>(with_text);
    plan<og::RRT>(with_text);
    plan<og::TRRT>(with_text);
    plan<og::PRM>(with_text);
    objectives<og::TRRT>();
    objectives<og::BiTRRT>();
    refused_at_once<og::TRRT>();
    refused_at_once<og::pRRT>();
    refused_at_once<og::PRM>();
    // The space says that it is R3.
    const auto plain = message_of<ompl::Exception>([] { plan<og::RRT>([](auto &planner) { wayfold::use(planner); }); });
    CHECK(plain.find("distance of two states") != std::string::npos);
    const auto other = message_of<ompl::Exception>(
        [&] { plan<og::RRT>([&](auto &planner) { wayfold::use(planner, "sum(R1:2, R1^2)", write); }); });
    CHECK(other.find("distance of two states") != std::string::npos);
    const auto infinite = message_of<ompl::Exception>([&] {
        plan<og::RRT>([&](auto &planner) { wayfold::use(planner, "sum(R1^3)", write); }, std::make_shared<Unreachable>());
    });
    CHECK(infinite.find("distance of two states is inf") != std::string::npos);
}

// Bounds that lie far from 0, and a space without reals: a distance that is not ours is refused at once.
void bounds_away_from_zero() {
    const auto far = std::make_shared<Joints>();
    far->setBounds(500, 510);
    const std::vector<ob::StateSpacePtr> spaces{far, std::make_shared<Gears>(), std::make_shared<Later>()};
    for (const ob::StateSpacePtr &space : spaces) {
        og::pRRT planner(std::make_shared<ob::SpaceInformation>(space));
        const auto refused = message_of<ompl::Exception>([&] { wayfold::use(planner); });
        CHECK(refused.find("distance of two states") != std::string::npos);
    }
}

// `use` reads no state that is not set. The planner's first states show a distance that is not ours.
void spaces_that_only_a_sampler_sets() {
    const auto opaque = std::make_shared<Opaque>();
    plan<og::RRT>([](auto &planner) { wayfold::use(planner, "sum(R1^3)", write); }, opaque);
    const auto refused = message_of<ompl::Exception>(
        [&] { plan<og::RRT>([](auto &planner) { wayfold::use(planner, "R3", write); }, opaque); });
    CHECK(refused.find("distance of two states") != std::string::npos);
    // One of the parts of a space.
    const auto both = std::make_shared<ob::CompoundStateSpace>();
    both->addSubspace(std::make_shared<Joints>(), 1);
    both->addSubspace(std::make_shared<Wrapper>(opaque), 1);
    og::RRT planner(std::make_shared<ob::SpaceInformation>(both));
    wayfold::use(planner, "sum(R1^6)", [](const ob::State *state, double *row) {
        const auto *parts = state->as<ob::CompoundState>();
        write(parts->components[0], row);
        write(parts->as<Wrapper::StateType>(1)->getState(), row + 3);
    });
}

// The unit sphere.
class Sphere : public ob::Constraint {
public:
    Sphere() : Constraint(3, 1) {}
    void function(const Eigen::Ref<const Eigen::VectorXd> &x, Eigen::Ref<Eigen::VectorXd> out) const override {
        out[0] = x.norm() - 1;
    }
};

// A constrained space is no metric for OMPL. Its states are those of the space around it.
void constrained_spaces() {
    auto around = std::make_shared<ob::RealVectorStateSpace>(3);
    around->setBounds(-2, 2);
    const auto space = std::make_shared<ob::ProjectedStateSpace>(around, std::make_shared<Sphere>());
    const auto si = std::make_shared<ob::ConstrainedSpaceInformation>(space);
    si->setStateValidityChecker([](const ob::State *) { return true; });
    si->setup();
    ob::ScopedState<> start(space), goal(space);
    start->as<ob::ConstrainedStateSpace::StateType>()->copy(Eigen::Vector3d(0, 0, -1));
    goal->as<ob::ConstrainedStateSpace::StateType>()->copy(Eigen::Vector3d(0, 0, 1));
    const auto definition = std::make_shared<ob::ProblemDefinition>(si);
    definition->setStartAndGoalStates(start, goal);
    og::RRTConnect planner(si);
    CHECK(message_of<ompl::Exception>([&] { wayfold::use(planner); }).find("is not a metric") != std::string::npos);
    wayfold::use(planner, "R3", [](const ob::State *state, double *row) {
        std::copy_n(state->as<ob::ConstrainedStateSpace::StateType>()->data(), 3, row);
    });
    solve(planner, definition);
}

// A motion with a cost, as in planners that search in the space of states and costs (AOX-RRT-Connect): they add the
// difference of costs to the distance.
struct CostMotion {
    ob::State *state;
    double cost;
};

void distances_with_costs() {
    const auto si = se2().si;
    const auto context = wayfold::detail::context_of(si);
    const auto sampler = si->allocStateSampler();
    std::vector<std::unique_ptr<CostMotion>> motions;
    for (int at = 0; at < 10; at++) {
        motions.push_back(std::make_unique<CostMotion>(CostMotion{si->allocState(), 0.5 * at}));
        sampler->sampleUniform(motions.back()->state);
    }
    wayfold::NearestNeighborsWayfold<CostMotion *> plain(context), with_costs(context), infinite(context);
    plain.setDistanceFunction(
        [&](CostMotion *const &a, CostMotion *const &b) { return si->distance(a->state, b->state); });
    with_costs.setDistanceFunction([&](CostMotion *const &a, CostMotion *const &b) {
        return si->distance(a->state, b->state) + std::fabs(a->cost - b->cost);
    });
    infinite.setDistanceFunction([](CostMotion *const &, CostMotion *const &) { return HUGE_VAL; });
    const auto add_all = [&](auto &neighbors) {
        for (const auto &motion : motions) {
            neighbors.add(motion.get());
        }
    };
    add_all(plain);
    CHECK(plain.size() == 10);
    for (auto *foreign : {&with_costs, &infinite}) {
        const auto refused = message_of<ompl::Exception>([&] { add_all(*foreign); });
        CHECK(refused.find("distance of two states") != std::string::npos);
    }
    for (const auto &motion : motions) {
        si->freeState(motion->state);
    }
}

// A checker that throws leaves a vertex that is not stored, and its edges. They stay in the graph of this process.
void a_checker_that_throws() {
    class Thrower : public discs::Motions {
    public:
        using Motions::Motions;
        bool checkMotion(const ob::State *from, const ob::State *to) const override {
            return --left_ != 0 ? Motions::checkMotion(from, to) : throw std::runtime_error("the checker's own");
        }
        mutable int left_{100};
    };
    const auto index = wayfold::Index::in_memory(roadmap::space);
    roadmap::Planner planner(index);
    for (int round = 0; round < 20; round++) {
        planner.si->setMotionValidator(std::make_shared<Thrower>(planner.si));
        refuses<std::runtime_error>("the checker's own", [&] { planner.grow(100); });
    }
    const og::PRM::Graph &graph = planner.prm->getRoadmap();
    bool has_edges = false;
    std::set<std::pair<std::uint64_t, std::uint64_t>> edges, stored;
    for (auto [edge, end] = boost::edges(graph); edge != end; ++edge) {
        const auto from = planner.prm->id(boost::source(*edge, graph));
        const auto to = planner.prm->id(boost::target(*edge, graph));
        has_edges |= !from || !to;
        if (from && to) {
            edges.insert(std::minmax(*from, *to));
        }
    }
    for (const auto &point : index.scan()) {
        for (const std::uint64_t other : wayfold::detail::edges_of(point.id, *index.payload(point.id))) {
            stored.insert(std::minmax(point.id, other));
        }
    }
    CHECK(has_edges && stored == edges && planner.prm->milestoneCount() == index.size() + 20);
}

// OMPL forgets the number of neighbours with the structure.
template <class P> void number_of_neighbors() {
    const auto problem = se2();
    P planner(problem.si);
    planner.setMaxNearestNeighbors(3);
    wayfold::use(planner);
    CHECK(wayfold::detail::strategy_k(planner) == 3);
}

// An allocator of planners with controls takes their space information, and says so if it gets another one.
void planners_with_controls() {
    const auto space = std::make_shared<ob::SE2StateSpace>();
    space->setBounds(box(2));
    const auto controls = std::make_shared<oc::RealVectorControlSpace>(space, 1);
    const auto si = std::make_shared<oc::SpaceInformation>(space, controls);
    si->setStatePropagator([](const ob::State *, const oc::Control *, double, ob::State *) {});
    const auto make = wayfold::allocator<oc::RRT>();
    CHECK(std::dynamic_pointer_cast<oc::RRT>(make(si)) != nullptr);
    refuses<ompl::Exception>("needs a control::SpaceInformation", [&] { make(se2().si); });
}

} // namespace

int main() {
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    wrappers();
    decimal_comma();
    spaces_of_ones_own();
    bounds_away_from_zero();
    spaces_that_only_a_sampler_sets();
    constrained_spaces();
    distances_with_costs();
    a_checker_that_throws();
    planners_with_controls();
    number_of_neighbors<og::PRM>();
    number_of_neighbors<og::LazyPRM>();
    std::cout << "traps: ok\n";
}
