// The error, the searches and the answers of an index. wayfold/wayfold.hpp includes it.
#pragma once

#include <wayfold.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace wayfold {

// The error of a call. The message names the field and the problem.
class Error : public std::runtime_error {
public:
    Error(wayfold_code code, const std::string &message, std::string field, std::string reason, std::size_t rows_done = 0,
          std::vector<std::uint64_t> ids = {})
        : std::runtime_error(message), code_(code), field_(std::move(field)), reason_(std::move(reason)),
          rows_done_(rows_done), ids_(std::move(ids)) {}

    wayfold_code code() const { return code_; }
    // The wrong field, such as "states[3].coords[1]"; empty if no field is wrong.
    const std::string &field() const { return field_; }
    // The reason in UPPER_SNAKE_CASE; empty if there is none.
    const std::string &reason() const { return reason_; }
    // The number of rows that are stored in spite of the error, from the first on; 0 unless the reason is PARTIAL.
    std::size_t rows_done() const { return rows_done_; }
    // The ids of these rows, from `insert_many`.
    const std::vector<std::uint64_t> &ids() const { return ids_; }

private:
    wayfold_code code_;
    std::string field_;
    std::string reason_;
    std::size_t rows_done_;
    std::vector<std::uint64_t> ids_;
};

namespace detail {

// `ids` are those that an insert of many rows wrote, or null.
inline void check(wayfold_code code, const std::uint64_t *ids = nullptr) {
    if (code != WAYFOLD_CODE_OK) {
        const std::size_t done = wayfold_error_rows_done();
        throw Error(code, wayfold_error_message(), wayfold_error_field(), wayfold_error_reason(), done,
                    ids == nullptr ? std::vector<std::uint64_t>() : std::vector<std::uint64_t>(ids, ids + done));
    }
}

inline wayfold_point point_of(std::uint64_t tag, const std::string &payload, std::optional<std::uint64_t> own_id) {
    if (own_id >= std::uint64_t{1} << 63) {
        // In wayfold.h, UINT64_MAX is no id.
        throw Error(WAYFOLD_CODE_INVALID_ARGUMENT, "id: " + std::to_string(*own_id) + "; ids are below 2^63", "id",
                    "INVALID_ARGUMENT");
    }
    wayfold_point point = wayfold_point_default();
    point.id = own_id.value_or(point.id);
    point.tag = tag;
    point.payload = reinterpret_cast<const std::uint8_t *>(payload.data());
    point.payload_bytes = payload.size();
    return point;
}

// Reads again if the text did not fit.
template <class Read> std::string read_text(std::string &text, Read read) {
    for (;;) {
        std::size_t bytes = 0;
        check(read(text.data(), text.size(), &bytes));
        const bool fits = bytes <= text.size();
        text.resize(bytes);
        if (fits) {
            return std::move(text);
        }
    }
}

} // namespace detail

struct Neighbor {
    std::uint64_t id;
    double distance;

    friend bool operator==(const Neighbor &a, const Neighbor &b) { return a.id == b.id && a.distance == b.distance; }
    friend bool operator!=(const Neighbor &a, const Neighbor &b) { return !(a == b); }
};

struct StoredPoint {
    std::uint64_t id;
    std::uint64_t tag;
    std::vector<double> state;
};

// Everything that changed after an earlier answer.
struct Changes {
    std::vector<StoredPoint> stored;
    std::vector<std::uint64_t> removed;
    std::uint64_t read_revision;
};

// An own point's place in the order of a shared index, and the neighbours before it that its insert could not see, or left out
// because its scaled `k` was smaller then.
struct Meanwhile {
    std::uint64_t id;
    // The number of points before it; if `is_superset`, maybe at a later moment.
    std::size_t points_before;
    std::vector<Neighbor> neighbors;
    // Some of the neighbours may be known from the insert, or come after the point.
    bool is_superset;
};

struct MeanwhileAnswers {
    std::vector<Meanwhile> answers;
    // The number of inserts whose answers are still to come.
    std::size_t open{0};
    // Answers were dropped, because none were read for long.
    bool has_dropped{false};
};

#ifndef WAYFOLD_NO_NET
// By what a client knows its server, and a server its client.
class Credentials {
public:
    // The certificates of the authorities that certify the server, in PEM. An address with https needs them.
    Credentials &ca_certificate(std::string pem) {
        ca_certificate_ = std::move(pem);
        return *this;
    }
    // The certificate of this client, and those between it and its authority, with its private key, both in PEM.
    Credentials &client_certificate(std::string certificate, std::string key) {
        client_certificate_ = std::move(certificate);
        client_key_ = std::move(key);
        return *this;
    }
    // The token of an identity of the server. Without TLS everyone on the way can read it.
    Credentials &token(std::string token) {
        token_ = std::move(token);
        return *this;
    }
    void set(wayfold_server &server) const {
        const auto optional = [](const std::string &text) { return text.empty() ? nullptr : text.c_str(); };
        server.token = optional(token_);
        server.ca_certificate = optional(ca_certificate_);
        server.client_certificate = optional(client_certificate_);
        server.client_key = optional(client_key_);
    }

private:
    std::string ca_certificate_, client_certificate_, client_key_, token_;
};

// How the payloads of an index hold edges, for programs that read them: the ids at the other ends, 8 bytes each,
// little-endian; or ids with costs (double), 16 bytes an edge. An index that exists keeps its own.
enum class PayloadEncoding : std::uint32_t { none = 0, edges = 1, weighted_edges = 2 };

// An index to create if it is missing.
struct NewIndex {
    NewIndex() = default;
    NewIndex(std::string space_text, PayloadEncoding encoding = PayloadEncoding::none)
        : space(std::move(space_text)), payload_encoding(encoding) {}
    NewIndex(const char *space_text) : space(space_text) {}

    // Empty: the index must exist.
    std::string space;
    PayloadEncoding payload_encoding{PayloadEncoding::none};
};

// The state of a shared index's connection.
struct ConnectionStatus {
    wayfold_status name;
    // The number of revisions by which the server was ahead; of WAYFOLD_STATUS_FOLLOWING.
    std::uint64_t behind;
    // The error of WAYFOLD_STATUS_DISCONNECTED, WAYFOLD_STATUS_REFUSED and WAYFOLD_STATUS_ENDED.
    std::string why;
};

// A write that was not sent, or that the server refused.
struct UnsentWrite {
    wayfold_unsent_kind kind;
    std::uint64_t id;
    std::uint64_t tag;
    // Empty unless a point was stored or moved.
    std::vector<double> state;
    std::string payload;
};
#endif

namespace detail {

// The points of a handle, which is freed. A state has `width` numbers.
inline Changes changes_of(wayfold_points *raw_points, std::size_t width) {
    const std::unique_ptr<wayfold_points, void (*)(wayfold_points *)> points(raw_points, wayfold_points_free);
    Changes changes{{}, {}, wayfold_points_read_revision(raw_points)};
    const std::size_t count = wayfold_points_count(raw_points);
    const std::uint64_t *ids = wayfold_points_ids(raw_points);
    const std::uint64_t *tags = wayfold_points_tags(raw_points);
    const double *states = wayfold_points_states(raw_points);
    for (std::size_t at = 0; at < count; at++) {
        const double *state = states + at * width;
        changes.stored.push_back({ids[at], tags[at], std::vector<double>(state, state + width)});
    }
    std::size_t removed = 0;
    const std::uint64_t *removed_ids = wayfold_points_removed(raw_points, &removed);
    changes.removed.assign(removed_ids, removed_ids + removed);
    return changes;
}

#ifndef WAYFOLD_NO_NET
// The writes of a handle, which is freed.
inline std::vector<UnsentWrite> unsent_of(wayfold_unsent *raw_unsent, std::size_t width) {
    const std::unique_ptr<wayfold_unsent, void (*)(wayfold_unsent *)> unsent(raw_unsent, wayfold_unsent_free);
    std::vector<UnsentWrite> writes;
    wayfold_unsent_write one{};
    for (std::size_t at = 0; wayfold_unsent_get(raw_unsent, at, &one); at++) {
        UnsentWrite write{one.kind, one.id, one.tag, {}, {}};
        if (one.state != nullptr) {
            write.state.assign(one.state, one.state + width);
        }
        write.payload.assign(reinterpret_cast<const char *>(one.payload), one.payload_bytes);
        writes.push_back(std::move(write));
    }
    return writes;
}
#endif

} // namespace detail

// Where the trees of an index in memory are merged: on two threads that all indices of the process share, or in the
// insert that makes a merge due.
enum class Merging { background, in_line };

// A search: the number of neighbours, the radius, and the points that count.
class Search {
public:
    static Search k(std::uint32_t k) {
        if (k == 0) {
            // In wayfold.h, 0 is without a limit.
            throw Error(WAYFOLD_CODE_INVALID_ARGUMENT, "k: 0; it is at least 1", "k", "INVALID_ARGUMENT");
        }
        Search search;
        search.raw_.k = k;
        return search;
    }
    // The ⌈factor · ln n⌉ nearest of n points, at least 1.
    static Search k_factor(double factor) {
        Search search;
        search.raw_.k_factor = check_factor(factor, "k_factor");
        return search;
    }
    static Search within(double radius) { return Search().radius(radius); }

    Search &radius(double radius) {
        raw_.radius = radius;
        return *this;
    }
    // The radius of PRM*, min(radius, factor · (ln n / n)^(1/d)).
    Search &radius_factor(double factor) {
        raw_.radius_factor = check_factor(factor, "radius_factor");
        return *this;
    }
    Search &tag(std::uint64_t mask, std::uint64_t value) {
        raw_.tag_mask = mask;
        raw_.tag_value = value;
        return *this;
    }
    Search &since(std::uint64_t revision) {
        raw_.since = revision;
        return *this;
    }
    Search &epsilon(double epsilon) {
        raw_.epsilon = epsilon;
        return *this;
    }
    // A search that takes longer fails with the reason SEARCH_TIMEOUT.
    Search &timeout(std::uint64_t timeout_ms) {
        if (timeout_ms == 0) {
            // In wayfold.h, 0 is without a limit.
            throw Error(WAYFOLD_CODE_INVALID_ARGUMENT, "timeout: 0 ms; it is at least 1", "timeout", "INVALID_ARGUMENT");
        }
        raw_.timeout_ms = timeout_ms;
        return *this;
    }
    const wayfold_search &raw() const { return raw_; }

private:
    static double check_factor(double factor, const char *field) {
        if (factor < 0) {
            // In wayfold.h, a negative factor is no factor.
            throw Error(WAYFOLD_CODE_INVALID_ARGUMENT,
                        std::string(field) + ": " + std::to_string(factor) + "; it is at least 0", field,
                        "INVALID_ARGUMENT");
        }
        return factor;
    }

    Search() : raw_(wayfold_search_default()) {}

    wayfold_search raw_;
};

} // namespace wayfold
