// The spaces of the race: OMPL's, or OMPL's with a distance that is one function without assertions.
#pragma once

#include "../tests/problem.hpp"

#include <cmath>
#include <memory>

// The distances are OMPL's to the bit, so that planners grow the same trees in both.
class BareSE3 final : public ob::SE3StateSpace {
public:
    double distance(const ob::State *a, const ob::State *b) const override {
        const auto *one = static_cast<const StateType *>(a);
        const auto *other = static_cast<const StateType *>(b);
        const double *from = one->as<ob::RealVectorStateSpace::StateType>(0)->values;
        const double *to = other->as<ob::RealVectorStateSpace::StateType>(0)->values;
        double squares = 0;
        for (int at = 0; at < 3; at++) {
            const double difference = from[at] - to[at];
            squares += difference * difference;
        }
        const auto &p = one->rotation();
        const auto &q = other->rotation();
        const double cosine = std::fabs(p.x * q.x + p.y * q.y + p.z * q.z + p.w * q.w);
        return std::sqrt(squares) + (cosine > 1.0 - 1e-9 ? 0.0 : std::acos(cosine));
    }
};

class BareSE2 final : public ob::SE2StateSpace {
public:
    double distance(const ob::State *a, const ob::State *b) const override {
        const auto *one = static_cast<const StateType *>(a);
        const auto *other = static_cast<const StateType *>(b);
        const double x = one->getX() - other->getX();
        const double y = one->getY() - other->getY();
        const double turn = std::fabs(one->getYaw() - other->getYaw());
        return std::sqrt(x * x + y * y) + 0.5 * (turn > M_PI ? 2.0 * M_PI - turn : turn);
    }
};

#ifdef BARE
using SE3 = BareSE3;
using SE2 = BareSE2;
#else
using SE3 = ob::SE3StateSpace;
using SE2 = ob::SE2StateSpace;
#endif
