// Wayfold's index as a nearest-neighbour structure of OMPL's planners. One line:
//
//     og::RRTConnect planner(si);
//     wayfold::use(planner);
#pragma once

#include <wayfold/ompl_neighbors.hpp>
#include <wayfold/ompl_space.hpp>
#include <wayfold/wayfold.hpp>

#include <ompl/base/Planner.h>
#include <ompl/base/ProblemDefinition.h>
#include <ompl/base/SpaceInformation.h>
#include <ompl/geometric/planners/prm/ConnectionStrategy.h>
#include <ompl/geometric/planners/prm/LazyPRM.h>
#include <ompl/geometric/planners/prm/PRM.h>
#include <ompl/geometric/planners/prm/SPARStwo.h>
#include <ompl/geometric/planners/rrt/TRRT.h>
#include <ompl/tools/config/SelfConfig.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <memory>
#include <random>
#include <string>
#include <type_traits>
#include <typeinfo>
#include <utility>
#include <vector>

namespace ompl::control {
class SpaceInformation;
class SyclopRRT;
} // namespace ompl::control

namespace ompl::geometric {
class ATRRT;
class BITstar;
class QuotientSpaceGraph;
class SPARSdb;
class TSRRT;
} // namespace ompl::geometric

namespace wayfold {

namespace detail {

template <class P, class = void> struct CanSwap : std::false_type {};
// The setNearestNeighbors of BIT* and of quotient spaces has no body in OMPL's headers: a call of it would not link. That of
// ATRRT, in OMPL 2.0, reads a structure that is not made yet. SPARSdb does not tell the states of its vertices. TSRRT measures
// the distance of projections, and asks for the neighbours of motions whose state is not set. That of SyclopRRT sets the planner
// up, which a planner that is set up again does not survive.
template <class P, class... Refused> constexpr bool is_none_of = !(std::is_base_of_v<Refused, P> || ...);
template <class P>
struct CanSwap<P, std::void_t<decltype(std::declval<P &>().template setNearestNeighbors<NearestNeighborsWayfold>())>>
    : std::bool_constant<is_none_of<P, ompl::control::SyclopRRT, ompl::geometric::ATRRT, ompl::geometric::BITstar,
                                    ompl::geometric::QuotientSpaceGraph, ompl::geometric::SPARSdb, ompl::geometric::TSRRT>> {};

// The states of a roadmap's vertices are in a protected property map, which a derived class may name.
template <class Roadmap> struct Vertices : Roadmap {
    static auto states() { return &Vertices::stateProperty_; }
};

template <class Roadmap> void read_vertices(Roadmap &planner, Context &context) {
    using Vertex = typename Roadmap::Vertex;
    context.vertex_type = &typeid(Vertex);
    context.vertex = [&planner](const void *vertex) -> const ompl::base::State * {
        return boost::get(planner.*Vertices<Roadmap>::states(), *static_cast<const Vertex *>(vertex));
    };
}

// Does what TRRT's setNearestNeighbors would do: it reads the structure that it replaces, and there is none before setup.
struct TrrtStructure : ompl::geometric::TRRT {
    static void set(ompl::geometric::TRRT &planner) {
        planner.clear();
        planner.*(&TrrtStructure::nearestNeighbors_) = std::make_shared<NearestNeighborsWayfold<Motion *>>();
    }
};

// LazyPRM does not tell its strategy, which a derived class may name.
struct LazyStrategy : ompl::geometric::LazyPRM {
    static const ConnectionStrategy &of(const LazyPRM &planner) { return planner.*(&LazyStrategy::connectionStrategy_); }
};

// The number of neighbours to which a strategy of k nearest ones connects a vertex, or 0.
template <class P> unsigned int strategy_k([[maybe_unused]] const P &planner) {
    if constexpr (std::is_base_of_v<ompl::geometric::PRM, P>) {
        return planner.getMaxNearestNeighbors();
    } else if constexpr (std::is_base_of_v<ompl::geometric::LazyPRM, P>) {
        using Strategy = ompl::geometric::KBoundedStrategy<ompl::geometric::LazyPRM::Vertex>;
        const auto *strategy = LazyStrategy::of(planner).template target<Strategy>();
        return strategy != nullptr ? strategy->getNumNeighbors() : 0;
    } else {
        return 0;
    }
}

// Tells a planner that it is not set up. OMPL's setNearestNeighbors sets it up, and it would not read the objective of a
// problem that it gets later.
struct SetupFlag : ompl::base::Planner {
    static void clear(ompl::base::Planner &planner) { planner.*(&SetupFlag::setup_) = false; }
};

// The same of a space information, which would ignore a resolution of motion checks that is set later.
struct InformationFlag : ompl::base::SpaceInformation {
    static void clear(ompl::base::SpaceInformation &information) { information.*(&InformationFlag::setup_) = false; }
};

// Sets a space information up for the time of a scope, also of one that an exception ends.
class InformationSetup {
public:
    explicit InformationSetup(ompl::base::SpaceInformation &information)
        : information_(information), was_setup_(information.isSetup()) {
        if (!was_setup_) {
            information_.setup();
        }
    }
    InformationSetup(const InformationSetup &) = delete;
    InformationSetup &operator=(const InformationSetup &) = delete;
    ~InformationSetup() {
        if (!was_setup_) {
            InformationFlag::clear(information_);
        }
    }

private:
    ompl::base::SpaceInformation &information_;
    const bool was_setup_;
};

// Gives a planner without a problem an empty one for the time of a scope: SST and others read an objective when the swap
// sets them up. The end of the scope, even by an exception, gives the planner its own problem back, and its setup.
class PlannerSetup {
public:
    explicit PlannerSetup(ompl::base::Planner &planner)
        : planner_(planner), had_problem_(planner.getProblemDefinition() != nullptr), was_setup_(planner.isSetup()) {
        if (!had_problem_) {
            const auto &information = planner_.getSpaceInformation();
            planner_.setProblemDefinition(std::make_shared<ompl::base::ProblemDefinition>(information));
        }
    }
    PlannerSetup(const PlannerSetup &) = delete;
    PlannerSetup &operator=(const PlannerSetup &) = delete;
    ~PlannerSetup() {
        if (!had_problem_) {
            planner_.setProblemDefinition(ompl::base::ProblemDefinitionPtr());
        }
        if (!was_setup_) {
            SetupFlag::clear(planner_);
        }
    }

private:
    ompl::base::Planner &planner_;
    const bool had_problem_;
    const bool was_setup_;
};

// True if each part of the space has a serialized form or as many reals as dimensions: they set all of a new state.
inline bool is_settable(const ompl::base::StateSpace *space) {
    namespace ob = ompl::base;
    if (const auto *wrapper = dynamic_cast<const ob::WrapperStateSpace *>(space)) {
        return is_settable(wrapper->getSpace().get());
    }
    if (const auto *compound = dynamic_cast<const ob::CompoundStateSpace *>(space)) {
        const auto &parts = compound->getSubspaces();
        return std::all_of(parts.begin(), parts.end(), [](const auto &part) { return is_settable(part.get()); });
    }
    return space->getSerializationLength() > 0 || space->getValueLocations().size() >= space->getDimension();
}

// Sets a number to a random one within its bounds, if it has any.
inline void draw(double &number, double low, double high, std::mt19937 &random) {
    if (low < high && std::isfinite(high - low)) {
        number = std::uniform_real_distribution<double>(low, high)(random);
    }
}

// Does so with all numbers of a state: their bounds may be far from 0.
inline void draw(const ompl::base::StateSpace *space, ompl::base::State *state, std::mt19937 &random) {
    namespace ob = ompl::base;
    if (const auto *wrapper = dynamic_cast<const ob::WrapperStateSpace *>(space)) {
        draw(wrapper->getSpace().get(), state->as<ob::WrapperStateSpace::StateType>()->getState(), random);
    } else if (const auto *compound = dynamic_cast<const ob::CompoundStateSpace *>(space)) {
        for (unsigned int at = 0; at < compound->getSubspaceCount(); at++) {
            draw(compound->getSubspace(at).get(), state->as<ob::CompoundState>()->components[at], random);
        }
    } else if (const auto *reals = dynamic_cast<const ob::RealVectorStateSpace *>(space)) {
        const ob::RealVectorBounds &bounds = reals->getBounds();
        for (unsigned int at = 0; at < space->getDimension(); at++) {
            draw(state->as<ob::RealVectorStateSpace::StateType>()->values[at], bounds.low[at], bounds.high[at], random);
        }
    } else if (const auto *time = dynamic_cast<const ob::TimeStateSpace *>(space)) {
        draw(state->as<ob::TimeStateSpace::StateType>()->position, time->getMinTimeBound(), time->getMaxTimeBound(), random);
    } else if (const auto *integers = dynamic_cast<const ob::DiscreteStateSpace *>(space)) {
        state->as<ob::DiscreteStateSpace::StateType>()->value =
            std::uniform_int_distribution<int>(integers->getLowerBound(), integers->getUpperBound())(random);
    }
}

// Compares the space's distance with ours before the planner runs: it might have threads then, which cannot throw. The
// states are made without OMPL's samplers, whose seeds the planner's own samplers would miss.
inline void check_space(const Context &context) {
    const auto &space = context.information->getStateSpace();
    if (!is_settable(space.get())) {
        // A new state would be read before it has values. The first elements of the planner are compared anyway.
        return;
    }
    const Index index = Index::in_memory(context.text, Merging::in_line);
    const double extent = space->getMaximumExtent();
    const double most = std::isfinite(extent) && extent > 0 ? extent : 1;
    std::mt19937 random(1);
    std::uniform_real_distribution<double> uniform(-most, most);
    const std::vector<char> zeros(space->getSerializationLength());
    std::vector<double> reals(space->getValueLocations().size());
    constexpr std::size_t count = 8;
    std::vector<std::shared_ptr<ompl::base::State>> states;
    std::vector<std::vector<double>> rows(count, std::vector<double>(index.width()));
    for (std::size_t at = 0; at < count; at++) {
        states.emplace_back(space->allocState(), [&space](ompl::base::State *state) { space->freeState(state); });
        ompl::base::State *state = states.back().get();
        space->deserialize(state, zeros.data());
        std::generate(reals.begin(), reals.end(), [&] { return uniform(random); });
        space->copyFromReals(state, reals);
        draw(space.get(), state, random);
        space->enforceBounds(state);
        context.write(state, rows[at].data());
        for (std::size_t other = 0; other < at; other++) {
            check_distance(index.distance(rows[other].data(), rows[at].data()),
                           space->distance(states[other].get(), state), context.text, space.get());
        }
    }
}

template <class P> void use(P &planner, Context context) {
    namespace og = ompl::geometric;
    context.information = planner.getSpaceInformation();
    const InformationSetup information_setup(*context.information);
    check_space(context);
    if constexpr (std::is_base_of_v<og::PRM, P>) {
        read_vertices<og::PRM>(planner, context);
    } else if constexpr (std::is_base_of_v<og::LazyPRM, P>) {
        read_vertices<og::LazyPRM>(planner, context);
    } else if constexpr (std::is_base_of_v<og::SPARStwo, P>) {
        read_vertices<og::SPARStwo>(planner, context);
    }
    const Scope scope(context);
    const unsigned int k = strategy_k(planner);
    {
        const PlannerSetup planner_setup(planner);
        if constexpr (std::is_base_of_v<og::TRRT, P>) {
            TrrtStructure::set(planner);
        } else {
            planner.template setNearestNeighbors<NearestNeighborsWayfold>();
        }
    }
    if constexpr (std::is_base_of_v<og::LazyPRM, P>) {
        // Its connection strategy has copied the range, which only setup would compute: nothing would be connected.
        double range = planner.getRange();
        if (range == 0) {
            ompl::tools::SelfConfig(context.information, planner.getName()).configurePlannerRange(range);
            planner.setRange(range);
        }
    }
    if constexpr (std::is_base_of_v<og::PRM, P> || std::is_base_of_v<og::LazyPRM, P>) {
        // The swap has set the default strategy.
        if (k > 0 && k != strategy_k(planner)) {
            planner.setMaxNearestNeighbors(k);
        }
    }
}

// The space information of planners with controls, whose headers are theirs to include: the type is complete once P is.
template <class P> struct ControlInformation {
    using type = ompl::control::SpaceInformation;
};

// Makes a planner. OMPL's planners with controls take their own space information.
template <class P> std::shared_ptr<P> make_planner(const ompl::base::SpaceInformationPtr &information) {
    if constexpr (std::is_constructible_v<P, const ompl::base::SpaceInformationPtr &>) {
        return std::make_shared<P>(information);
    } else {
        using Information = typename ControlInformation<P>::type;
        constexpr bool has_controls = std::is_constructible_v<P, const std::shared_ptr<Information> &>;
        static_assert(has_controls, "wayfold::allocator cannot make this planner: its constructor takes more than a space "
                                    "information. Make it in an allocator of your own, and call wayfold::use");
        if constexpr (has_controls) {
            const auto controls = std::dynamic_pointer_cast<Information>(information);
            if (controls == nullptr) {
                throw ompl::Exception("wayfold: a planner with controls needs a control::SpaceInformation");
            }
            return std::make_shared<P>(controls);
        } else {
            return nullptr;
        }
    }
}

} // namespace detail

// Makes a planner use Wayfold's index. Call it before the planner's setup, with the bounds of its space set: it clears
// the planner, and refuses a distance that is not ours. The number of neighbours of PRM and LazyPRM stays. Set a connection
// strategy of your own afterwards: it would hold the structure that this call replaces.
template <class P> void use(P &planner, Merging merging = Merging::background) {
    static_assert(detail::CanSwap<P>::value,
                  "the nearest neighbours of this planner cannot be swapped. Name the planner's own type, as in "
                  "og::RRTConnect; a base::Planner does not know it");
    if constexpr (detail::CanSwap<P>::value) {
        auto context = detail::context_of(planner.getSpaceInformation());
        context.merging = merging;
        detail::use(planner, context);
    }
}

// For spaces of your own: a space text, and a function that writes a state's row.
template <class P>
void use(P &planner, const std::string &space, StateToRow write, Merging merging = Merging::background) {
    static_assert(detail::CanSwap<P>::value,
                  "the nearest neighbours of this planner cannot be swapped. Name the planner's own type, as in "
                  "og::RRTConnect; a base::Planner does not know it");
    if constexpr (detail::CanSwap<P>::value) {
        detail::Context context;
        context.text = space;
        context.custom = std::move(write);
        context.merging = merging;
        detail::use(planner, context);
    }
}

// An allocator of planners that use Wayfold's index, where OMPL makes the planner, as in SimpleSetup and MoveIt.
template <class P> ompl::base::PlannerAllocator allocator() {
    return [](const ompl::base::SpaceInformationPtr &information) -> ompl::base::PlannerPtr {
        const auto planner = detail::make_planner<P>(information);
        use(*planner);
        return planner;
    };
}

// For spaces of your own: a space text, and a function that writes a state's row.
template <class P>
ompl::base::PlannerAllocator allocator(const std::string &space, const StateToRow &write,
                                       Merging merging = Merging::background) {
    return [=](const ompl::base::SpaceInformationPtr &information) -> ompl::base::PlannerPtr {
        const auto planner = detail::make_planner<P>(information);
        use(*planner, space, write, merging);
        return planner;
    };
}

} // namespace wayfold
