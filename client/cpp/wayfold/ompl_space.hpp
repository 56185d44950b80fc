// A state space of OMPL as a space of Wayfold. wayfold/ompl.hpp includes it.
#pragma once

#include <wayfold/types.hpp>
#include <ompl/base/StateSpace.h>
#include <ompl/base/spaces/DiscreteStateSpace.h>
#include <ompl/base/spaces/RealVectorStateSpace.h>
#include <ompl/base/spaces/SO2StateSpace.h>
#include <ompl/base/spaces/SO3StateSpace.h>
#include <ompl/base/spaces/TimeStateSpace.h>
#include <ompl/base/spaces/WrapperStateSpace.h>
#include <ompl/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <functional>
#include <iomanip>
#include <locale>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

namespace wayfold {

// Writes a state's row: the numbers of the space text, in order.
using StateToRow = std::function<void(const ompl::base::State *, double *)>;
// Sets a state to a row.
using RowToState = std::function<void(const double *, ompl::base::State *)>;

namespace detail {

// The sum of the weights of a space's SO3 parts. Weights of nested spaces multiply.
inline double so3_weight(const ompl::base::StateSpace *space) {
    namespace ob = ompl::base;
    if (const auto *wrapper = dynamic_cast<const ob::WrapperStateSpace *>(space)) {
        return so3_weight(wrapper->getSpace().get());
    }
    if (const auto *compound = dynamic_cast<const ob::CompoundStateSpace *>(space)) {
        double sum = 0;
        for (unsigned int at = 0; at < compound->getSubspaceCount(); at++) {
            sum += compound->getSubspaceWeight(at) * so3_weight(compound->getSubspace(at).get());
        }
        return sum;
    }
    return dynamic_cast<const ob::SO3StateSpace *>(space) != nullptr ? 1 : 0;
}

// Compares our distance with OMPL's: a space may override it, and a planner may add costs to it. Without a `space`, the
// rotations of the text have no tolerance of their own.
inline void check_distance(double ours, double theirs, const std::string &text, const ompl::base::StateSpace *space) {
    // OMPL's distance of rotations is 0 where their quaternions' product is above 1 - 1e-9, and ours is up to
    // acos(1 - 1e-9) there. Both are half of the angle.
    constexpr double so3_difference = 4.5e-5;
    const double difference = std::fabs(ours - theirs), tolerance = 1e-4 + 1e-6 * std::fabs(theirs);
    // An infinite distance would have an infinite tolerance.
    if (!std::isfinite(theirs) ||
        !(difference <= tolerance || difference <= tolerance + so3_difference * so3_weight(space))) {
        throw ompl::Exception("wayfold: the planner's distance of two states is " + std::to_string(theirs) +
                              ", and that of " + text + " is " + std::to_string(ours) +
                              ": keep OMPL's own nearest neighbours here, or give the space text of this metric");
    }
}

} // namespace detail

// A state space of OMPL as a space text, and its states as rows. A compound space is the weighted sum of its parts;
// nested ones are flattened.
class OmplSpace {
public:
    explicit OmplSpace(const ompl::base::StateSpacePtr &space) : space_(space) {
        if (!space->isMetricSpace()) {
            throw ompl::Exception("wayfold: the distance of " + space->getName() +
                                  " is not a metric; keep OMPL's own nearest neighbours for it, or give wayfold::use a "
                                  "space text");
        }
        root_ = part(space.get(), 1.0);
        std::string sum;
        for (const std::string &argument : arguments_) {
            sum += (sum.empty() ? "" : ", ") + argument;
        }
        text_ = "sum(" + sum + ")";
    }

    const std::string &text() const { return text_; }
    std::size_t width() const { return width_; }
    void write(const ompl::base::State *state, double *row) const { write(root_, state, row); }
    void read(const double *row, ompl::base::State *state) const { read(root_, row, state); }

private:
    enum class Kind { compound, wrapper, real, so2, so3, time, discrete };

    struct Part {
        Kind kind;
        unsigned int numbers;
        std::vector<Part> parts;
    };

    Part part(const ompl::base::StateSpace *space, double weight) {
        namespace ob = ompl::base;
        if (const auto *wrapper = dynamic_cast<const ob::WrapperStateSpace *>(space)) {
            return {Kind::wrapper, 0, {part(wrapper->getSpace().get(), weight)}};
        }
        if (const auto *compound = dynamic_cast<const ob::CompoundStateSpace *>(space)) {
            Part all{Kind::compound, 0, {}};
            for (unsigned int at = 0; at < compound->getSubspaceCount(); at++) {
                const double own = compound->getSubspaceWeight(at);
                all.parts.push_back(part(compound->getSubspace(at).get(), weight * own));
            }
            return all;
        }
        if (dynamic_cast<const ob::RealVectorStateSpace *>(space) != nullptr) {
            const unsigned int n = space->getDimension();
            return n == 0 ? Part{Kind::real, 0, {}} : leaf(Kind::real, n, "R" + std::to_string(n), weight);
        }
        if (dynamic_cast<const ob::SO2StateSpace *>(space) != nullptr) {
            return leaf(Kind::so2, 1, "SO2", weight);
        }
        if (dynamic_cast<const ob::SO3StateSpace *>(space) != nullptr) {
            return leaf(Kind::so3, 4, "SO3", weight);
        }
        if (dynamic_cast<const ob::TimeStateSpace *>(space) != nullptr) {
            return leaf(Kind::time, 1, "R1", weight);
        }
        if (dynamic_cast<const ob::DiscreteStateSpace *>(space) != nullptr) {
            return leaf(Kind::discrete, 1, "R1", weight);
        }
        throw ompl::Exception("wayfold: " + space->getName() +
                              " is no space that Wayfold knows; give wayfold::use a space text and a function that "
                              "writes a state's row");
    }

    Part leaf(Kind kind, unsigned int numbers, std::string text, double weight) {
        if (weight != 1.0) {
            // In every locale of the process, a space text has decimal points.
            std::ostringstream digits;
            digits.imbue(std::locale::classic());
            digits << ':' << std::setprecision(17) << weight;
            text += digits.str();
        }
        arguments_.push_back(std::move(text));
        width_ += numbers;
        return {kind, numbers, {}};
    }

    static double *write(const Part &part, const ompl::base::State *state, double *row) {
        namespace ob = ompl::base;
        switch (part.kind) {
        case Kind::compound: {
            const auto *compound = static_cast<const ob::CompoundState *>(state);
            for (std::size_t at = 0; at < part.parts.size(); at++) {
                row = write(part.parts[at], compound->components[at], row);
            }
            return row;
        }
        case Kind::wrapper:
            return write(part.parts[0], static_cast<const ob::WrapperStateSpace::StateType *>(state)->getState(), row);
        case Kind::real: {
            const double *values = static_cast<const ob::RealVectorStateSpace::StateType *>(state)->values;
            for (unsigned int at = 0; at < part.numbers; at++) {
                *row++ = values[at];
            }
            return row;
        }
        case Kind::so2:
            *row++ = static_cast<const ob::SO2StateSpace::StateType *>(state)->value;
            return row;
        case Kind::so3: {
            const auto *rotation = static_cast<const ob::SO3StateSpace::StateType *>(state);
            *row++ = rotation->x;
            *row++ = rotation->y;
            *row++ = rotation->z;
            *row++ = rotation->w;
            return row;
        }
        case Kind::time:
            *row++ = static_cast<const ob::TimeStateSpace::StateType *>(state)->position;
            return row;
        case Kind::discrete:
            *row++ = static_cast<const ob::DiscreteStateSpace::StateType *>(state)->value;
            return row;
        }
        return row;
    }

    static const double *read(const Part &part, const double *row, ompl::base::State *state) {
        namespace ob = ompl::base;
        switch (part.kind) {
        case Kind::compound: {
            auto *compound = static_cast<ob::CompoundState *>(state);
            for (std::size_t at = 0; at < part.parts.size(); at++) {
                row = read(part.parts[at], row, compound->components[at]);
            }
            return row;
        }
        case Kind::wrapper:
            return read(part.parts[0], row, static_cast<ob::WrapperStateSpace::StateType *>(state)->getState());
        case Kind::real:
            std::copy(row, row + part.numbers, static_cast<ob::RealVectorStateSpace::StateType *>(state)->values);
            return row + part.numbers;
        case Kind::so2:
            static_cast<ob::SO2StateSpace::StateType *>(state)->value = *row;
            return row + 1;
        case Kind::so3: {
            auto *rotation = static_cast<ob::SO3StateSpace::StateType *>(state);
            rotation->x = row[0];
            rotation->y = row[1];
            rotation->z = row[2];
            rotation->w = row[3];
            return row + 4;
        }
        case Kind::time:
            static_cast<ob::TimeStateSpace::StateType *>(state)->position = *row;
            return row + 1;
        case Kind::discrete:
            static_cast<ob::DiscreteStateSpace::StateType *>(state)->value = static_cast<int>(std::lround(*row));
            return row + 1;
        }
        return row;
    }

    // Keeps the parts alive.
    ompl::base::StateSpacePtr space_;
    std::vector<std::string> arguments_;
    std::string text_;
    std::size_t width_{0};
    Part root_{Kind::compound, 0, {}};
};

} // namespace wayfold
