// Planning problems whose checks are cheap: balls of invalid positions.
#pragma once

#include <memory>
#include <ompl/base/SpaceInformation.h>
#include <ompl/base/goals/GoalState.h>
#include <ompl/base/ProblemDefinition.h>
#include <ompl/base/ScopedState.h>
#include <ompl/base/spaces/SE2StateSpace.h>
#include <ompl/base/spaces/SE3StateSpace.h>

namespace ob = ompl::base;

struct Problem {
    ob::SpaceInformationPtr si;
    ob::ProblemDefinitionPtr definition;
};

// `x` reads the first coordinate of a position. A wall at x = 9 cuts the goal off: planners run until they are ended.
template <class X> Problem make_problem(const ob::StateSpacePtr &space, X x) {
    auto si = std::make_shared<ob::SpaceInformation>(space);
    si->setStateValidityChecker([x](const ob::State *state) {
        const double at = x(state);
        return at < 8.5 || at > 9.5;
    });
    si->setStateValidityCheckingResolution(0.02);
    si->setup();
    auto definition = std::make_shared<ob::ProblemDefinition>(si);
    return {si, definition};
}

inline ob::RealVectorBounds box(unsigned int n) {
    ob::RealVectorBounds bounds(n);
    bounds.setLow(0);
    bounds.setHigh(10);
    return bounds;
}

// `space` may be derived from OMPL's.
inline Problem se3_in(const std::shared_ptr<ob::SE3StateSpace> &space) {
    space->setBounds(box(3));
    auto problem = make_problem(space, [](const ob::State *s) { return s->as<ob::SE3StateSpace::StateType>()->getX(); });
    ob::ScopedState<ob::SE3StateSpace> start(space), goal(space);
    start->setXYZ(1, 1, 1);
    start->rotation().setIdentity();
    goal->setXYZ(9.8, 9, 9);
    goal->rotation().setAxisAngle(0, 0, 1, 1);
    problem.definition->clearStartStates();
    problem.definition->setStartAndGoalStates(start, goal);
    return problem;
}

inline Problem se3() { return se3_in(std::make_shared<ob::SE3StateSpace>()); }

inline Problem se2_in(const std::shared_ptr<ob::SE2StateSpace> &space) {
    space->setBounds(box(2));
    auto problem = make_problem(space, [](const ob::State *s) { return s->as<ob::SE2StateSpace::StateType>()->getX(); });
    ob::ScopedState<ob::SE2StateSpace> start(space), goal(space);
    start->setXY(1, 1);
    start->setYaw(0);
    goal->setXY(9.8, 9);
    goal->setYaw(1);
    problem.definition->clearStartStates();
    problem.definition->setStartAndGoalStates(start, goal);
    return problem;
}

inline Problem se2() { return se2_in(std::make_shared<ob::SE2StateSpace>()); }
