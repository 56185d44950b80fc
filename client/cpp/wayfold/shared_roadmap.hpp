// The exchange of wayfold/shared_prm.hpp, which includes it, with the index: it takes over vertices and edges of other
// processes, and stores those of this one.
#pragma once

#include <wayfold/roadmap_graph.hpp>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <future>
#include <limits>
#include <optional>
#include <set>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

namespace wayfold::detail {

// All functions run with the lock of PRM's graph.
class SharedRoadmap : public RoadmapGraph {
protected:
    using Clock = std::chrono::steady_clock;

    // The ends of waits.
    static constexpr Clock::time_point at_once{}, for_ever = Clock::time_point::max();

    SharedRoadmap(const ompl::base::SpaceInformationPtr &si, const Index &index, RowsOfStates rows, bool star)
        : RoadmapGraph(si, star), index_(index), rows_(std::move(rows)), queries_(Index::in_memory(rows_.text())) {}

    // The graph is empty: the next exchange loads all vertices.
    void forget() {
        ids_.clear();
        vertices_.clear();
        own_edges_.clear();
        changed_.clear();
        missing_.clear();
        late_.clear();
        arriving_.clear();
        reading_ = {};
        search_.reset();
        offered_.reset();
        known_edges_ = 0;
        read_revision_ = 0;
        is_loaded_ = false;
    }

    void forget_queries() {
        queries_.clear();
        query_vertices_.clear();
    }

    std::vector<double> row_of(Vertex vertex) const {
        std::vector<double> row(index_.width());
        rows_.write(stateProperty_[vertex], row.data());
        return row;
    }

    // A start or goal state.
    void add_query(Vertex vertex) { query_vertices_.emplace(queries_.insert(row_of(vertex)), vertex); }

    void check_distances(Vertex vertex) {
        for (Vertex other = vertex; other > 0 && vertex - other < 8 && unchecked_distances_ > 0; unchecked_distances_--) {
            other--;
            const double ours = index_.distance(row_of(other).data(), row_of(vertex).data());
            check_distance(ours, distanceFunction(other, vertex), rows_.text(), si_->getStateSpace().get());
        }
    }

    // A sampled vertex, with its edges.
    void store(Vertex vertex) {
        const std::vector<double> row = row_of(vertex);
        std::vector<std::uint64_t> edges = take_edges(vertex), near;
        std::uint64_t id = no_id;
        if (asked_ == vertex && search_) {
            // An answer within a radius may grow until the insert; vertices beyond this room come too late to be tried.
            const std::size_t k = search_->raw().k, most = index_.size() + 1024;
            const std::size_t room = k > 0 ? std::min(k, most) : most;
            id = index_.insert(row.data(), 0, payload_of(edges), *search_, room, near);
        } else {
            id = index_.insert(row, 0, payload_of(edges));
        }
        ids_[vertex] = id;
        vertices_.emplace(id, vertex);
        own_edges_.emplace(id, std::move(edges));
        for (const std::uint64_t other : near) {
            if (!std::binary_search(tried_.begin(), tried_.end(), other)) {
                late_.emplace_back(id, other);
            }
        }
        search_.reset();
    }

    // Waits until then for the payloads of others.
    void synchronize(Clock::time_point until) {
        take_edges(boost::graph_traits<Graph>::null_vertex());
        take_answers(std::chrono::milliseconds(0));
        // A call waits for one read during an outage.
        if (take_read(until)) {
            start_reading();
            if (until != at_once) {
                take_read(until);
            }
        }
        try_late_motions();
        for (const std::uint64_t id : changed_) {
            index_.set_payload(id, payload_of(own_edges_[id]));
        }
        changed_.clear();
    }

    // Vertices that others stored before an own one, and that its insert could not see.
    void take_answers(std::chrono::milliseconds timeout) {
        const MeanwhileAnswers taken = index_.meanwhile(static_cast<std::uint64_t>(timeout.count()));
        for (const Meanwhile &answer : taken.answers) {
            for (const Neighbor &near : answer.neighbors) {
                late_.emplace_back(answer.id, near.id);
            }
        }
        unanswered_ = taken.open;
        if (taken.has_dropped) {
            OMPL_WARN("%s: edges to vertices of other processes are missed: none were asked for in time",
                      getName().c_str());
        }
    }

    // The nearest vertices of the roadmap, and in addition the start and goal states that are as near: those take no edge
    // from the roadmap.
    void find_near(Vertex vertex, const Search &search, std::vector<Vertex> &found) {
        if (offered_) {
            const double radius = search.raw().radius;
            if (distanceFunction(vertex, *offered_) <= radius) {
                found.push_back(*offered_);
            }
            return;
        }
        const std::vector<double> row = row_of(vertex);
        std::vector<std::pair<double, Vertex>> near;
        asked_ = vertex;
        search_ = search;
        tried_.clear();
        const std::size_t count = search_others(vertex, row, search);
        const bool is_full = search.raw().k > 0 && count >= search.raw().k;
        const double radius = is_full ? near_distances_[count - 1] : search.raw().radius;
        for (std::size_t at = 0; at < count; at++) {
            const auto known = vertices_.find(near_ids_[at]);
            if (known != vertices_.end()) {
                near.emplace_back(near_distances_[at], known->second);
                tried_.push_back(near_ids_[at]);
            }
        }
        std::sort(tried_.begin(), tried_.end());
        if (!query_vertices_.empty()) {
            for (const Neighbor &query : queries_.search(row, Search::within(radius))) {
                if (query_vertices_.at(query.id) != vertex) {
                    near.emplace_back(query.distance, query_vertices_.at(query.id));
                }
            }
            std::stable_sort(near.begin(), near.end(), [](const auto &a, const auto &b) { return a.first < b.first; });
        }
        for (const auto &[distance, other] : near) {
            found.push_back(other);
        }
    }

    const Index index_;
    std::size_t unanswered_{0};
    // An own vertex and a neighbour that it has not tried.
    std::vector<std::pair<std::uint64_t, std::uint64_t>> late_;
    const RowsOfStates rows_;
    // The start and goal states, which the index does not have.
    const Index queries_;
    std::future<std::vector<std::optional<std::string>>> reading_;

private:
    // Searches the index, and leaves out the vertex itself, which the index has if it is another process's. Returns the
    // number of neighbours.
    std::size_t search_others(Vertex vertex, const std::vector<double> &row, const Search &search) {
        const std::uint32_t k = search.raw().k;
        const bool is_stored = vertex < ids_.size() && !is_query(vertex);
        Search with_itself = search;
        if (is_stored && k > 0 && k < std::numeric_limits<std::uint32_t>::max()) {
            with_itself = Search::k(k + 1).radius(search.raw().radius);
        }
        const std::size_t found = index_.search_into(row.data(), with_itself, near_ids_, &near_distances_);
        std::size_t count = 0;
        for (std::size_t at = 0; at < found; at++) {
            if (!is_stored || near_ids_[at] != ids_[vertex]) {
                near_ids_[count] = near_ids_[at];
                near_distances_[count] = near_distances_[at];
                count++;
            }
        }
        return k > 0 ? std::min<std::size_t>(count, k) : count;
    }

    // Takes over the payloads that have been read. During an outage they are asked for again later. Returns false if it
    // has waited for them in vain.
    bool take_read(Clock::time_point until) {
        if (!reading_.valid()) {
            return true;
        }
        const bool has_ended = reading_.wait_for(Clock::duration::zero()) == std::future_status::ready;
        const Clock::duration left = std::max(until - Clock::now(), Clock::duration::zero());
        if (until != for_ever && reading_.wait_for(left) != std::future_status::ready) {
            return true;
        }
        try {
            take_over(reading_.get());
            arriving_.clear();
            is_loaded_ = true;
            return true;
        } catch (const Error &error) {
            if (!is_outage(error) || !is_loaded_) {
                throw;
            }
            return has_ended;
        }
    }

    // Asks for the payloads of what has changed. Another thread waits for the network.
    void start_reading() {
        if (reading_.valid()) {
            return;
        }
        if (arriving_.empty()) {
            find_changes();
        }
        std::vector<std::uint64_t> ids;
        for (const StoredPoint &point : arriving_) {
            ids.push_back(point.id);
        }
        if (ids.empty()) {
            is_loaded_ = true;
        } else {
            reading_ = std::async(std::launch::async, [index = index_, ids] { return index.payloads(ids); });
        }
    }

    void find_changes() {
        Changes changes = changes_after(index_, is_loaded_ ? std::optional(read_revision_) : std::nullopt, vertices_);
        // The index may have been made again.
        check_encoding(index_);
        for (const std::uint64_t id : changes.removed) {
            if (vertices_.count(id) > 0) {
                const auto status = index_.status();
                if (status && status->name == WAYFOLD_STATUS_REFUSED) {
                    // The copy has lost the refused vertices: this throws the refusal.
                    index_.flush();
                }
                throw ompl::Exception(getName(), "vertex " + std::to_string(id) + " was removed from the index; clear "
                                                 "the planner to load the rest");
            }
            late_.erase(std::remove_if(late_.begin(), late_.end(), [id](const auto &at) { return at.second == id; }),
                        late_.end());
        }
        for (StoredPoint &point : changes.stored) {
            check_place(point);
            if (own_edges_.count(point.id) == 0) {
                arriving_.push_back(std::move(point));
            }
        }
        read_revision_ = changes.read_revision;
    }

    // Refuses a vertex that another program has moved: its edges were checked where it was. Functions of the caller that
    // write and read states may round.
    void check_place(const StoredPoint &point) const {
        constexpr double max_rounding = 1e-4;
        const auto known = vertices_.find(point.id);
        if (known != vertices_.end() &&
            index_.distance(row_of(known->second).data(), point.state.data()) > max_rounding) {
            throw ompl::Exception(getName(), "vertex " + std::to_string(point.id) +
                                                 " was moved in the index, where nobody has checked its edges; remove it "
                                                 "there, and clear the planner to load the rest");
        }
    }

    // Adds vertices and edges of others, which they have checked.
    void take_over(const std::vector<std::optional<std::string>> &payloads) {
        // All are read before the graph changes, so that a payload that is none of a vertex leaves it as it was.
        std::vector<std::vector<std::uint64_t>> edges(arriving_.size());
        for (std::size_t at = 0; at < arriving_.size(); at++) {
            if (payloads[at]) {
                edges[at] = edges_of(arriving_[at].id, *payloads[at]);
            }
        }
        std::vector<Vertex> fresh;
        for (std::size_t at = 0; at < arriving_.size(); at++) {
            const StoredPoint &point = arriving_[at];
            // A point without an answer was removed: the next changes name it.
            if (payloads[at] && vertices_.count(point.id) == 0) {
                const Vertex vertex = boost::add_vertex(g_);
                stateProperty_[vertex] = si_->allocState();
                rows_.read(point.state.data(), stateProperty_[vertex]);
                totalConnectionAttemptsProperty_[vertex] = 1;
                successfulConnectionAttemptsProperty_[vertex] = 0;
                disjointSets_.make_set(vertex);
                ids_.push_back(point.id);
                vertices_.emplace(point.id, vertex);
                fresh.push_back(vertex);
            }
        }
        for (std::size_t at = 0; at < arriving_.size(); at++) {
            for (const std::uint64_t other : edges[at]) {
                link(arriving_[at].id, other);
            }
        }
        for (const Vertex vertex : fresh) {
            const auto waiting = missing_.find(ids_[vertex]);
            if (waiting != missing_.end()) {
                const std::vector<std::uint64_t> from = std::move(waiting->second);
                missing_.erase(waiting);
                for (const std::uint64_t id : from) {
                    link(id, ids_[vertex]);
                }
            }
        }
        known_edges_ = boost::num_edges(g_);
        if (!query_vertices_.empty() && !fresh.empty()) {
            try_queries(fresh);
        }
    }

    // Tries motions between start and goal states and the vertices of other processes that have arrived together, in
    // ascending order. A vertex whose neighbours are those that arrived with it does not find a query that is near: each
    // query searches too.
    void try_queries(const std::vector<Vertex> &fresh) {
        std::set<std::pair<Vertex, Vertex>> motions;
        for (const Vertex vertex : fresh) {
            for (const Vertex other : connectionStrategy_(vertex)) {
                if (is_query(other)) {
                    motions.emplace(vertex, other);
                }
            }
        }
        for (const auto &[id, query] : query_vertices_) {
            for (const Vertex other : connectionStrategy_(query)) {
                if (std::binary_search(fresh.begin(), fresh.end(), other)) {
                    motions.emplace(other, query);
                }
            }
        }
        for (const auto &[vertex, query] : motions) {
            try_motion(vertex, query);
        }
    }

    void try_late_motions() {
        std::vector<std::pair<std::uint64_t, std::uint64_t>> waiting;
        for (const auto &[id, other_id] : late_) {
            if (own_edges_.count(id) == 0) {
                // Stored before `clear`.
                continue;
            }
            const auto other = vertices_.find(other_id);
            if (other == vertices_.end()) {
                // The graph never gets a point that was removed before.
                if (index_.get(other_id).has_value()) {
                    waiting.emplace_back(id, other_id);
                }
                continue;
            }
            // The strategy decides about it as about a neighbour that it finds.
            const Vertex vertex = vertices_.at(id);
            offered_ = other->second;
            const std::vector<Vertex> wanted = connectionStrategy_(vertex);
            offered_.reset();
            if (std::find(wanted.begin(), wanted.end(), other->second) != wanted.end() &&
                try_motion(vertex, other->second)) {
                record(vertex, other->second);
            }
        }
        late_ = std::move(waiting);
    }

    std::unordered_map<std::uint64_t, Vertex> query_vertices_;
    // Changes up to this revision are in the graph, or among those that arrive.
    std::uint64_t read_revision_{0};
    bool is_loaded_{false};
    std::vector<StoredPoint> arriving_;
    // The last search of the strategy, its vertex, and the ids that it found.
    Vertex asked_{0};
    std::optional<Search> search_;
    std::vector<std::uint64_t> tried_;
    std::vector<std::uint64_t> near_ids_;
    std::vector<double> near_distances_;
    // The only neighbour that a search finds, while a late motion is tried.
    std::optional<Vertex> offered_;
    unsigned int unchecked_distances_{256};
};

} // namespace wayfold::detail
