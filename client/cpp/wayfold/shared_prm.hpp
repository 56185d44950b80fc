// OMPL's PRM on one roadmap that many processes grow:
//
//     auto planner = std::make_shared<wayfold::SharedPRM>(si, url, "roadmap");
//     setup.setPlanner(planner);
//
// A vertex is a point of the index. Its payload has the ids at the ends of its edges, in eight bytes each,
// little-endian. The process that stores a vertex has checked the state and these edges; all others take them over
// unchecked. The later of two vertices in the index's order tries the motion to the earlier.
#pragma once

#include <wayfold/shared_roadmap.hpp>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

namespace wayfold {

// Solves and grows like PRM; use it through this type or a base::Planner, because og::PRM's own methods that grow the
// roadmap do not report errors of the index. Each planner opens the index for itself: what others stored meanwhile is
// told once. Start and goal states are vertices of this process alone. An error of the index ends the call, which throws
// it (wayfold::Error); so do all further calls until `clear`, except after a `flush` that was late: call it again.
class SharedPRM : public detail::SharedRoadmap {
    using Condition = ompl::base::PlannerTerminationCondition;

public:
    // On the server's index of this name, which is made if there is none, and declares PayloadEncoding::edges then. One that
    // exists must declare the same: payloads of another meaning may look like edges. With `star`, connects like PRM*.
    SharedPRM(const ompl::base::SpaceInformationPtr &si, const std::string &uri, const std::string &name, bool star = false,
              const Credentials &credentials = {})
        : SharedPRM(si,
                    Index::shared(uri, name, {OmplSpace(si->getStateSpace()).text(), PayloadEncoding::edges}, credentials),
                    star) {}

    // On an index that this planner alone has opened: in memory, or a shared one that declares PayloadEncoding::edges.
    SharedPRM(const ompl::base::SpaceInformationPtr &si, const Index &index, bool star = false)
        : SharedPRM(si, index, detail::RowsOfStates(si->getStateSpace()), star) {}

    // For spaces of your own: functions that write a state's row, and set a state to a row.
    SharedPRM(const ompl::base::SpaceInformationPtr &si, const Index &index, StateToRow write, RowToState read,
              bool star = false)
        : SharedPRM(si, index, detail::RowsOfStates(index.space(), std::move(write), std::move(read)), star) {}

    using ompl::base::Planner::solve;
    ompl::base::PlannerStatus solve(const Condition &condition) override {
        checkValidity();
        ompl::base::PlannerStatus status;
        run([&] { status = PRM::solve(until(condition)); });
        return status;
    }
    void constructRoadmap(const Condition &condition) {
        run([&] { PRM::constructRoadmap(until(condition)); });
    }
    void growRoadmap(const Condition &condition) {
        run([&] { PRM::growRoadmap(until(condition)); });
    }
    void growRoadmap(double seconds) { growRoadmap(ompl::base::timedPlannerTerminationCondition(seconds)); }
    void expandRoadmap(const Condition &condition) {
        run([&] { PRM::expandRoadmap(until(condition)); });
    }
    void expandRoadmap(double seconds) { expandRoadmap(ompl::base::timedPlannerTerminationCondition(seconds)); }

    // Adds the vertices and edges of others that this process's copy of the index has. Every call that grows or solves
    // begins with it.
    void refresh() {
        run([] {});
    }

    // Waits until the server has every vertex and edge of this process, also the edges to vertices that others stored
    // meanwhile, which it checks. Without it, a process that ends may lose its last ones.
    void flush(std::chrono::milliseconds timeout = std::chrono::seconds(30)) {
        using std::chrono::milliseconds;
        // A much longer time would overflow the clock.
        const auto end = Clock::now() + std::clamp<milliseconds>(timeout, milliseconds(0), std::chrono::hours(24 * 365));
        const auto left = [&] {
            return std::max(std::chrono::duration_cast<milliseconds>(end - Clock::now()), milliseconds(0));
        };
        for (bool is_done = false; !is_done;) {
            const auto action = [&] {
                index_.flush_within(static_cast<std::uint64_t>(left().count()));
                const std::lock_guard<std::mutex> lock(graphMutex_);
                guarded([&] {
                    take_answers(std::min(left(), milliseconds(100)));
                    synchronize(end);
                });
                is_done = unanswered_ == 0 && late_.empty() && index_.pending() == 0;
            };
            run(action, end);
            if (!is_done && Clock::now() > end) {
                throw Error(WAYFOLD_CODE_DEADLINE_EXCEEDED, "flush: the roadmap is not stored in time", "timeout", "");
            }
        }
    }

    // Forgets the graph of this process; the next call loads the shared roadmap again. Nothing is removed from the
    // index. Edges that a `flush` would have checked are not tried any more. Writes that the server has refused are
    // dropped: `index().take_unsent()` has them before.
    void clear() override {
        if (reading_.valid()) {
            reading_.wait();
        }
        PRM::clear();
        install_samplers();
        const std::size_t refused = index_.take_unsent().size();
        if (refused > 0) {
            OMPL_WARN("%s: %zu writes that the server has refused are dropped", getName().c_str(), refused);
        }
        forget();
        failure_ = nullptr;
        has_failed_ = false;
    }

    // The old start and goal states stay in the graph of this process, and get no further edges.
    void clearQuery() override {
        PRM::clearQuery();
        const std::lock_guard<std::mutex> lock(graphMutex_);
        forget_queries();
    }

    // The id of a vertex in the index; none for one that the index does not have, as a start or goal state.
    std::optional<std::uint64_t> id(Vertex vertex) const {
        return vertex < ids_.size() && !is_query(vertex) ? std::optional<std::uint64_t>(ids_[vertex]) : std::nullopt;
    }

    const Index &index() const { return index_; }

    // The vertices are in the shared index.
    template <template <typename> class NN> void setNearestNeighbors() = delete;

private:
    friend class detail::RoadmapNeighbors<SharedPRM>;

    SharedPRM(const ompl::base::SpaceInformationPtr &si, const Index &index, detail::RowsOfStates rows, bool star)
        : SharedRoadmap(si, index, std::move(rows), star) {
        setName(star ? "SharedPRMstar" : "SharedPRM");
        if (queries_.space() != index.space()) {
            throw ompl::Exception("wayfold: the states of " + si->getStateSpace()->getName() + " are those of " +
                                  queries_.space() + ", and the index has the space " + index.space());
        }
        try {
            // The first exchange needs the revision of now, which a remote index refuses to tell.
            index.changes(~std::uint64_t{0});
        } catch (const Error &error) {
            if (error.code() == WAYFOLD_CODE_INVALID_ARGUMENT) {
                throw ompl::Exception("wayfold: a roadmap needs an index in memory or a shared one, not a remote one");
            }
            throw;
        }
        detail::check_encoding(index);
        nn_ = std::make_shared<detail::RoadmapNeighbors<SharedPRM>>(*this);
        nn_->setDistanceFunction([this](const Vertex &a, const Vertex &b) { return distanceFunction(a, b); });
        install_samplers();
    }

    // PRM uses samplers that are there. These tell vertices that are sampled from start and goal states.
    void install_samplers() {
        sampler_ = std::make_shared<detail::MarkingValidSampler>(si_.get(), grower_);
        marking_sampler_->clear();
        simpleSampler_ = marking_sampler_;
    }

    // Exchanges with the index until the deadline at most, runs an action, and exchanges again.
    template <class Action> void run(Action action, Clock::time_point until = for_ever) {
        if (!isSetup()) {
            setup();
        }
        if (opt_ == nullptr) {
            throw ompl::Exception(getName(), "set a problem definition first: it has the costs of edges");
        }
        grower_ = std::thread::id();
        exchange(until);
        action();
        grower_ = std::thread::id();
        exchange(at_once);
    }

    void exchange(Clock::time_point until) {
        const std::lock_guard<std::mutex> lock(graphMutex_);
        guarded([&] { synchronize(until); });
        if (failure_ != nullptr) {
            std::rethrow_exception(failure_);
        }
    }

    Condition until(const Condition &condition) {
        return Condition([this, condition] { return has_failed_ || condition(); });
    }

    // Keeps the error: PRM calls this where an exception would end the process, or leave its graph locked.
    template <class Action> void guarded(Action action) noexcept {
        if (!has_failed_) {
            try {
                action();
            } catch (...) {
                failure_ = std::current_exception();
                has_failed_ = true;
            }
        }
    }

    // PRM has made a vertex and its edges. It holds the lock of the graph.
    void add(Vertex vertex) {
        guarded([&] {
            check_distances(vertex);
            if (grower_.load() == std::this_thread::get_id()) {
                store(vertex);
                synchronize(at_once);
            } else {
                add_query(vertex);
            }
        });
    }

    void search(Vertex vertex, const Search &search, std::vector<Vertex> &found) {
        found.clear();
        guarded([&] { find_near(vertex, search, found); });
    }

    // The thread that samples vertices.
    std::atomic<std::thread::id> grower_{};
    // There is one of them, because each draws one of the process's seeds. PRM draws it for the generator of its GNAT: so
    // the samplers of the space get the same seeds as in PRM.
    const std::shared_ptr<detail::MarkingSampler> marking_sampler_{
        std::make_shared<detail::MarkingSampler>(si_.get(), grower_)};
    std::exception_ptr failure_;
    std::atomic<bool> has_failed_{false};
};

} // namespace wayfold
