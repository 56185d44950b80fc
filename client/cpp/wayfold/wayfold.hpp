// Exact nearest-neighbour indices for motion planners, in C++17: the methods of the Rust client over wayfold.h.
#pragma once

#include <wayfold/types.hpp>

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace wayfold {

// A dynamic set of states with exact nearest-neighbour search. Copies share the points. All methods are thread-safe.
class Index {
public:
    static Index in_memory(const std::string &space, Merging merging = Merging::background) {
        wayfold_index *made = nullptr;
        detail::check(wayfold_index_in_memory(space.c_str(), merging == Merging::in_line, &made));
        return Index(made);
    }

#ifndef WAYFOLD_NO_NET
    // A copy of the server's index in this process. An empty `create`: the index must exist. `timeout_ms` is the longest
    // time of a call; 0 for the client's own, 30 s. A write waits while `max_pending_bytes` are pending; 0 for the client's
    // own, 16 MiB.
    static Index shared(const std::string &uri, const std::string &name, const NewIndex &create = {},
                        const Credentials &credentials = {}, std::uint64_t timeout_ms = 0,
                        std::uint64_t max_pending_bytes = 0) {
        wayfold_server server = wayfold_server_default();
        server.max_pending_bytes = max_pending_bytes;
        return open(wayfold_index_shared, server, uri, name, create, credentials, timeout_ms);
    }
    // Each call is one of the server's. With `latest`, searches, gets and scans see all that any server of a cluster
    // acknowledged before; otherwise they see the caller's own writes, and may lag behind those of others.
    static Index remote(const std::string &uri, const std::string &name, const NewIndex &create = {},
                        const Credentials &credentials = {}, std::uint64_t timeout_ms = 0, bool latest = false) {
        wayfold_server server = wayfold_server_default();
        server.reads_latest = latest ? 1 : 0;
        return open(wayfold_index_remote, server, uri, name, create, credentials, timeout_ms);
    }

    // How the payloads hold edges, as the index declared when it was created: another program may have created it, and a
    // payload that means something else may look like edges. `none` in memory and for an index that declares nothing.
    PayloadEncoding payload_encoding() const {
        std::uint32_t declared = 0;
        detail::check(wayfold_index_payload_encoding(raw(), &declared));
        return static_cast<PayloadEncoding>(declared);
    }
    // Waits until the server has acknowledged every write before this call, at most for the index's timeout.
    void flush() const { detail::check(wayfold_index_flush(raw())); }
    // The same, at most for this long.
    void flush_within(std::uint64_t timeout_ms) const { detail::check(wayfold_index_flush_within(raw(), timeout_ms)); }
    // The state of a shared index's connection; nothing for the other forms.
    std::optional<ConnectionStatus> status() const {
        ConnectionStatus status{WAYFOLD_STATUS_NOT_SHARED, 0, {}};
        std::string why(256, '\0');
        status.why = detail::read_text(why, [this, &status](char *room, std::size_t capacity, std::size_t *bytes) {
            return wayfold_index_status(raw(), &status.name, &status.behind, room, capacity, bytes);
        });
        return status.name == WAYFOLD_STATUS_NOT_SHARED ? std::nullopt : std::optional<ConnectionStatus>(std::move(status));
    }
    std::uint64_t pending() const {
        std::uint64_t pending = 0;
        detail::check(wayfold_index_pending(raw(), &pending));
        return pending;
    }
    // The answers about own points that were inserted with a search, each once, when the server has stored them. Waits
    // for one, at most this long, if there is none and one is to come.
    MeanwhileAnswers meanwhile(std::uint64_t timeout_ms = 0) const {
        wayfold_answers *raw_answers = nullptr;
        detail::check(wayfold_index_meanwhile(raw(), timeout_ms, &raw_answers));
        const std::unique_ptr<wayfold_answers, void (*)(wayfold_answers *)> read(raw_answers, wayfold_answers_free);
        MeanwhileAnswers all{{}, wayfold_answers_open(raw_answers), wayfold_answers_have_dropped(raw_answers)};
        wayfold_answer one{};
        for (std::size_t at = 0; wayfold_answers_get(raw_answers, at, &one); at++) {
            Meanwhile answer{one.id, one.points_before, std::vector<Neighbor>(one.count), one.is_superset};
            for (std::size_t near = 0; near < one.count; near++) {
                answer.neighbors[near] = {one.ids[near], one.distances[near]};
            }
            all.answers.push_back(std::move(answer));
        }
        return all;
    }
    // Every write from the first one on that the server refused for good, in order; the copy shows them no more. The
    // index takes writes again then. The server may have taken the first batch of them: after the reconnection look if
    // its points are there. Store a put again without an id that the index assigned: it is the ended session's.
    std::vector<UnsentWrite> take_unsent() const {
        wayfold_unsent *unsent = nullptr;
        detail::check(wayfold_index_take_unsent(raw(), &unsent));
        return detail::unsent_of(unsent, width_);
    }
    // Takes no more writes, waits for the pending ones, and returns those that the server has not acknowledged in time: it
    // may have taken the first of them.
    std::vector<UnsentWrite> close(std::uint64_t timeout_ms) const {
        wayfold_unsent *unsent = nullptr;
        detail::check(wayfold_index_close(raw(), timeout_ms, &unsent));
        return detail::unsent_of(unsent, width_);
    }
#endif

    // The text of the space. Equal spaces have equal texts.
    std::string space() const {
        std::string text(256, '\0');
        return detail::read_text(text, [this](char *room, std::size_t capacity, std::size_t *bytes) {
            return wayfold_index_space(raw(), room, capacity, bytes);
        });
    }
    // The numbers of a state.
    std::size_t width() const { return width_; }
    std::size_t size() const {
        std::size_t size = 0;
        detail::check(wayfold_index_size(raw(), &size));
        return size;
    }
    bool empty() const { return size() == 0; }

    std::uint64_t insert(const double *state) const {
        std::uint64_t id = 0;
        detail::check(wayfold_index_insert(raw(), state, 1, width_, &id));
        return id;
    }
    std::uint64_t insert(const std::vector<double> &state) const {
        std::uint64_t id = 0;
        detail::check(wayfold_index_insert(raw(), state.data(), 1, state.size(), &id));
        return id;
    }
    // Without it, the state {0} would be a null pointer.
    std::uint64_t insert(std::initializer_list<double> state) const { return insert(std::vector(state)); }
    // `states` are rows, one after the other. An index in memory stores all or none. The other forms may divide many rows,
    // and a part may fail after others were stored: the reason of the error is PARTIAL then, and it has the number and the
    // ids of the stored rows. Repeat only the rows after them: a repeated row is a second point. `wayfold_index_insert` says
    // when the next rows may be stored too.
    std::vector<std::uint64_t> insert_many(const double *states, std::size_t count) const {
        std::vector<std::uint64_t> ids(count);
        detail::check(wayfold_index_insert(raw(), states, count, width_, ids.data()), ids.data());
        return ids;
    }
    // The index assigns the id unless there is one, below 2^63. The insert fails if a point has it. A shared index looks in
    // its copy: of two processes that store the same id at once, the later one replaces the point, and both calls succeed.
    // Ids in a block that the server reserved for another process are refused, which ends the writes of this one until
    // `take_unsent`. Choose a range above all assigned ids, well below 2^63, then store and flush its last id first: the
    // server assigns only greater ids from then on, and the ids below it stay the caller's.
    std::uint64_t insert(const std::vector<double> &state, std::uint64_t tag, const std::string &payload = {},
                         std::optional<std::uint64_t> own_id = {}) const {
        const wayfold_point point = detail::point_of(tag, payload, own_id);
        std::uint64_t id = 0;
        detail::check(wayfold_index_insert_with(raw(), state.data(), state.size(), &point, &id, nullptr, 0, nullptr,
                                                nullptr, nullptr, nullptr));
        return id;
    }
    // Writes the neighbours that the state had at its insertion, nearest first, at most `capacity`, and the revision of
    // the insertion for `Search::since`, unless `read_revision` is null; returns the id. `meanwhile` tells later of the
    // points that others stored before the state and that the copy of a shared index did not have yet. A remote index does
    // not end this search by its timeout, but by that of the call. `distances` gets those of the neighbours unless it is
    // null. `own_id` is that of the insert above.
    std::uint64_t insert(const double *state, std::uint64_t tag, const std::string &payload, const Search &search,
                         std::size_t capacity, std::vector<std::uint64_t> &neighbors,
                         std::uint64_t *read_revision = nullptr, std::vector<double> *distances = nullptr,
                         std::optional<std::uint64_t> own_id = {}) const {
        const wayfold_point point = detail::point_of(tag, payload, own_id);
        std::uint64_t id = 0;
        std::size_t found = 0;
        neighbors.resize(capacity);
        if (distances != nullptr) {
            distances->resize(capacity);
        }
        detail::check(wayfold_index_insert_with(raw(), state, width_, &point, &id, &search.raw(), capacity,
                                                neighbors.data(), distances == nullptr ? nullptr : distances->data(),
                                                &found, read_revision));
        neighbors.resize(std::min(found, capacity));
        if (distances != nullptr) {
            distances->resize(neighbors.size());
        }
        return id;
    }
    // These return false if there is no point with this id.
    bool remove(std::uint64_t id) const {
        bool removed = false;
        detail::check(wayfold_index_remove(raw(), id, &removed));
        return removed;
    }
    // The point keeps its tag and loses its payload. A remote index makes two calls: a tag that another process sets between
    // them is lost, and a removal is undone; it returns true then too.
    bool replace(std::uint64_t id, const std::vector<double> &state) const {
        bool replaced = false;
        detail::check(wayfold_index_replace(raw(), id, state.data(), state.size(), &replaced));
        return replaced;
    }
    bool set_tag(std::uint64_t id, std::uint64_t tag) const {
        bool set = false;
        detail::check(wayfold_index_set_tag(raw(), id, tag, &set));
        return set;
    }
    bool set_payload(std::uint64_t id, const std::string &payload) const {
        bool set = false;
        const auto *bytes = reinterpret_cast<const std::uint8_t *>(payload.data());
        detail::check(wayfold_index_set_payload(raw(), id, bytes, payload.size(), &set));
        return set;
    }
    std::optional<StoredPoint> get(std::uint64_t id) const {
        StoredPoint point{id, 0, std::vector<double>(width_)};
        bool found = false;
        detail::check(wayfold_index_get(raw(), id, &point.tag, point.state.data(), width_, &found));
        return found ? std::optional<StoredPoint>(std::move(point)) : std::nullopt;
    }
    // Empty if the point has none; nothing if there is no such point.
    std::optional<std::string> payload(std::uint64_t id) const { return payloads({id})[0]; }
    // The payloads of the points with these ids; nothing in place of one if there is no such point. A
    // shared index asks its server once for a thousand of them.
    std::vector<std::optional<std::string>> payloads(const std::vector<std::uint64_t> &ids) const {
        wayfold_payloads *raw_payloads = nullptr;
        detail::check(wayfold_index_payloads(raw(), ids.data(), ids.size(), &raw_payloads));
        const std::unique_ptr<wayfold_payloads, void (*)(wayfold_payloads *)> read(raw_payloads, wayfold_payloads_free);
        std::vector<std::optional<std::string>> payloads(ids.size());
        for (std::size_t at = 0; at < ids.size(); at++) {
            std::size_t bytes = 0;
            const auto *payload = wayfold_payloads_get(raw_payloads, at, &bytes);
            if (payload != nullptr) {
                payloads[at] = std::string(reinterpret_cast<const char *>(payload), bytes);
            }
        }
        return payloads;
    }
    // For an index in memory only.
    void clear() const { detail::check(wayfold_index_clear(raw())); }
    // Removes all points that the index has now, for everybody: it reads all their ids first.
    void remove_all() const { detail::check(wayfold_index_remove_all(raw())); }

    std::optional<Neighbor> nearest(const double *state) const {
        Neighbor nearest{};
        bool found = false;
        detail::check(wayfold_index_nearest(raw(), state, width_, &nearest.id, &nearest.distance, &found));
        return found ? std::optional<Neighbor>(nearest) : std::nullopt;
    }
    std::optional<Neighbor> nearest(const std::vector<double> &state) const {
        check_width(state);
        return nearest(state.data());
    }
    // Without it, the state {0} would be a null pointer.
    std::optional<Neighbor> nearest(std::initializer_list<double> state) const { return nearest(std::vector(state)); }
    std::vector<Neighbor> nearest_k(const std::vector<double> &state, std::uint32_t k) const {
        return search(state, Search::k(k));
    }
    std::vector<Neighbor> nearest_r(const std::vector<double> &state, double radius) const {
        return search(state, Search::within(radius));
    }
    // Writes the revision that the answer read, for `Search::since`, unless `read_revision` is null.
    std::vector<Neighbor> search(const std::vector<double> &state, const Search &search,
                                 std::uint64_t *read_revision = nullptr) const {
        check_width(state);
        std::vector<std::uint64_t> ids;
        std::vector<double> distances;
        const std::size_t found = search_into(state.data(), search, ids, &distances, read_revision);
        std::vector<Neighbor> neighbors(found);
        for (std::size_t at = 0; at < found; at++) {
            neighbors[at] = {ids[at], distances[at]};
        }
        return neighbors;
    }
    // Writes the neighbours into the caller's buffers, which grow and never shrink, and returns their number. More than
    // expected are searched for again, and a timeout of the search begins again.
    // `distances` and `read_revision` may be null.
    std::size_t search_into(const double *state, const Search &search, std::vector<std::uint64_t> &ids,
                            std::vector<double> *distances = nullptr, std::uint64_t *read_revision = nullptr) const {
        std::size_t capacity = std::max<std::size_t>({ids.size(), 16});
        // A call for the size of a remote index would have a timeout of its own.
        constexpr std::size_t MOST_AT_FIRST = 65'536;
        capacity = std::max(capacity, std::min<std::size_t>(search.raw().k, MOST_AT_FIRST));
        for (;;) {
            ids.resize(std::max(ids.size(), capacity));
            if (distances != nullptr) {
                distances->resize(std::max(distances->size(), ids.size()));
            }
            std::size_t found = 0;
            detail::check(wayfold_index_search(raw(), state, 1, width_, &search.raw(), ids.size(), ids.data(),
                                               distances == nullptr ? nullptr : distances->data(), &found,
                                               read_revision));
            if (found <= ids.size()) {
                return found;
            }
            capacity = found + found / 2;
        }
    }
    // The k nearest of many states in one call: row i of the buffers, of k numbers, is that of state i.
    void nearest_k(const double *states, std::size_t count, std::uint32_t k, std::uint64_t *ids, double *distances,
                   std::size_t *found) const {
        const Search search = Search::k(k);
        detail::check(
            wayfold_index_search(raw(), states, count, width_, &search.raw(), k, ids, distances, found, nullptr));
    }
    // Answers a search of many states, rows one after the other, which see the same points. A remote index divides more
    // than 1,000 states, or a large answer, among calls, which may see different revisions; `read_revision` gets the
    // least, and nothing without a state.
    std::vector<std::vector<Neighbor>> search_many(const double *states, std::size_t count, const Search &search,
                                                   std::uint64_t *read_revision = nullptr) const {
        if (count == 0) {
            return {};
        }
        wayfold_results *raw_results = nullptr;
        detail::check(
            wayfold_index_search_many(raw(), states, count, width_, &search.raw(), &raw_results, read_revision));
        const std::unique_ptr<wayfold_results, void (*)(wayfold_results *)> read(raw_results, wayfold_results_free);
        std::vector<std::vector<Neighbor>> answers(count);
        for (std::size_t row = 0; row < count; row++) {
            const std::uint64_t *ids = nullptr;
            const double *distances = nullptr;
            answers[row].resize(wayfold_results_get(raw_results, row, &ids, &distances));
            for (std::size_t at = 0; at < answers[row].size(); at++) {
                answers[row][at] = {ids[at], distances[at]};
            }
        }
        return answers;
    }
    double distance(const double *a, const double *b) const {
        double distance = 0;
        detail::check(wayfold_index_distance(raw(), a, b, width_, &distance));
        return distance;
    }

    std::vector<StoredPoint> scan() const {
        wayfold_points *points = nullptr;
        detail::check(wayfold_index_scan(raw(), &points));
        return detail::changes_of(points, width_).stored;
    }
    // Nothing if the index has forgotten some of the changes: scan it then. `UINT64_MAX` reads only the revision of
    // now; a remote index refuses it.
    std::optional<Changes> changes(std::uint64_t since) const {
        wayfold_points *points = nullptr;
        detail::check(wayfold_index_changes(raw(), since, &points));
        return points == nullptr ? std::nullopt : std::optional<Changes>(detail::changes_of(points, width_));
    }

private:
    explicit Index(wayfold_index *made) : handle_(made, wayfold_index_free), width_(wayfold_index_width(made)) {}

    wayfold_index *raw() const { return handle_.get(); }

    void check_width(const std::vector<double> &state) const {
        if (state.size() != width_) {
            throw Error(WAYFOLD_CODE_INVALID_ARGUMENT,
                        "states[0]: " + std::to_string(state.size()) + " numbers, where a state of this space has " +
                            std::to_string(width_),
                        "states[0]", "WRONG_WIDTH");
        }
    }

#ifndef WAYFOLD_NO_NET
    using Open = wayfold_code (*)(const wayfold_server *, wayfold_index **);

    static Index open(Open open, wayfold_server server, const std::string &uri, const std::string &name,
                      const NewIndex &create, const Credentials &credentials, std::uint64_t timeout_ms) {
        server.uri = uri.c_str();
        server.name = name.c_str();
        server.space = create.space.empty() ? nullptr : create.space.c_str();
        server.payload_encoding = static_cast<std::uint32_t>(create.payload_encoding);
        server.timeout_ms = timeout_ms;
        credentials.set(server);
        wayfold_index *made = nullptr;
        detail::check(open(&server, &made));
        return Index(made);
    }
#endif

    std::shared_ptr<wayfold_index> handle_;
    std::size_t width_;
};

} // namespace wayfold
