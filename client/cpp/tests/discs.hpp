// A problem in SE2 whose checks are exact: discs that the position must not touch. It counts its checks.
#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <memory>
#include <ompl/base/MotionValidator.h>
#include <ompl/base/ProblemDefinition.h>
#include <ompl/base/ScopedState.h>
#include <ompl/base/SpaceInformation.h>
#include <ompl/base/spaces/SE2StateSpace.h>
#include <utility>

namespace discs {

namespace ob = ompl::base;
using Pose = ob::SE2StateSpace::StateType;

struct Disc {
    double x, y, radius;
};

inline constexpr std::array<Disc, 5> all{{{3, 3, 1.5}, {7, 3, 1.5}, {5, 6, 1.5}, {2, 8, 1}, {8, 8, 1}}};

// The least distance of the motion's positions to the edge of a disc: below 0 within one.
inline double clearance(const Pose &from, const Pose &to) {
    const double dx = to.getX() - from.getX(), dy = to.getY() - from.getY();
    const double length = dx * dx + dy * dy;
    double least = 100;
    for (const Disc &disc : all) {
        const double along = (disc.x - from.getX()) * dx + (disc.y - from.getY()) * dy;
        const double at = length > 0 ? std::clamp(along / length, 0.0, 1.0) : 0;
        const double x = from.getX() + at * dx, y = from.getY() + at * dy;
        least = std::min(least, std::hypot(x - disc.x, y - disc.y) - disc.radius);
    }
    return least;
}

// The counts of the states and motions that the planners of this process have checked.
inline std::atomic<unsigned int> checked_states{0}, checked_motions{0}, valid_motions{0};

class Motions : public ob::MotionValidator {
public:
    using MotionValidator::MotionValidator;

    bool checkMotion(const ob::State *from, const ob::State *to) const override {
        checked_motions++;
        const bool is_valid = clearance(*from->as<Pose>(), *to->as<Pose>()) > 1e-6;
        valid_motions += is_valid;
        return is_valid;
    }

    bool checkMotion(const ob::State *from, const ob::State *to, std::pair<ob::State *, double> &last) const override {
        checked_motions++;
        last.second = 1;
        ob::State *end = si_->cloneState(to);
        while (last.second > 0.01 && clearance(*from->as<Pose>(), *end->as<Pose>()) <= 1e-6) {
            last.second /= 2;
            si_->getStateSpace()->interpolate(from, to, last.second, end);
        }
        const bool is_valid = last.second == 1;
        if (last.second <= 0.01) {
            last.second = 0;
            si_->copyState(end, from);
        }
        if (last.first != nullptr) {
            si_->copyState(last.first, end);
        }
        si_->freeState(end);
        return is_valid;
    }
};

// Every motion is valid.
class AllMotions : public Motions {
public:
    using Motions::Motions;
    bool checkMotion(const ob::State *, const ob::State *) const override { return true; }
};

inline std::shared_ptr<ob::SpaceInformation> information() {
    const auto space = std::make_shared<ob::SE2StateSpace>();
    ob::RealVectorBounds bounds(2);
    bounds.setLow(0);
    bounds.setHigh(10);
    space->setBounds(bounds);
    auto si = std::make_shared<ob::SpaceInformation>(space);
    si->setStateValidityChecker([](const ob::State *state) {
        checked_states++;
        return clearance(*state->as<Pose>(), *state->as<Pose>()) > 1e-6;
    });
    si->setMotionValidator(std::make_shared<Motions>(si));
    si->setup();
    return si;
}

// From one corner to the opposite one.
inline ob::ProblemDefinitionPtr problem(const ob::SpaceInformationPtr &si) {
    ob::ScopedState<ob::SE2StateSpace> start(si->getStateSpace()), goal(si->getStateSpace());
    start->setXY(0.5, 0.5);
    start->setYaw(0);
    goal->setXY(9.5, 9.5);
    goal->setYaw(1);
    auto definition = std::make_shared<ob::ProblemDefinition>(si);
    definition->setStartAndGoalStates(start, goal);
    return definition;
}

} // namespace discs
