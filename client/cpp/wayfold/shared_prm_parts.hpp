// The parts of wayfold/shared_prm.hpp, which includes it: states as rows, payloads, samplers, and the interface of
// OMPL's nearest neighbours.
#pragma once

#include <wayfold/ompl_space.hpp>
#include <wayfold/wayfold.hpp>

#ifdef WAYFOLD_NO_NET
#error "wayfold::SharedPRM needs a library with the network: install it without -DWAYFOLD_NET=OFF"
#endif

#include <ompl/base/OptimizationObjective.h>
#include <ompl/base/SpaceInformation.h>
#include <ompl/base/StateSampler.h>
#include <ompl/base/ValidStateSampler.h>
#include <ompl/datastructures/NearestNeighbors.h>
#include <ompl/geometric/planners/prm/PRM.h>
#include <ompl/util/Console.h>
#include <ompl/util/Exception.h>

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <unordered_set>
#include <utility>
#include <vector>

namespace wayfold::detail {

// The states of a space as rows.
class RowsOfStates {
public:
    explicit RowsOfStates(const ompl::base::StateSpacePtr &space)
        : space_(std::make_shared<OmplSpace>(space)), text_(space_->text()) {}
    RowsOfStates(std::string text, StateToRow write, RowToState read)
        : text_(std::move(text)), write_(std::move(write)), read_(std::move(read)) {}

    const std::string &text() const { return text_; }
    void write(const ompl::base::State *state, double *row) const {
        space_ != nullptr ? space_->write(state, row) : write_(state, row);
    }
    void read(const double *row, ompl::base::State *state) const {
        space_ != nullptr ? space_->read(row, state) : read_(row, state);
    }

private:
    std::shared_ptr<const OmplSpace> space_;
    std::string text_;
    StateToRow write_;
    RowToState read_;
};

// The same call may succeed later: the errors after which the index repeats a write.
inline bool is_outage(const Error &error) {
    switch (error.code()) {
    case WAYFOLD_CODE_CANCELLED:
    case WAYFOLD_CODE_UNKNOWN:
    case WAYFOLD_CODE_DEADLINE_EXCEEDED:
    case WAYFOLD_CODE_INTERNAL:
    case WAYFOLD_CODE_UNAVAILABLE:
        return true;
    case WAYFOLD_CODE_RESOURCE_EXHAUSTED:
        return error.reason() != "LIMIT_EXCEEDED";
    default:
        return false;
    }
}

// The ids at the ends of a vertex's edges, ascending, in eight bytes each, little-endian.
inline std::string payload_of(std::vector<std::uint64_t> ids) {
    std::sort(ids.begin(), ids.end());
    // A connection strategy of the caller's may name a neighbour twice.
    ids.erase(std::unique(ids.begin(), ids.end()), ids.end());
    std::string payload;
    payload.reserve(8 * ids.size());
    for (const std::uint64_t id : ids) {
        for (unsigned int byte = 0; byte < 8; byte++) {
            payload.push_back(static_cast<char>(id >> (8 * byte)));
        }
    }
    return payload;
}

// Refuses an index of a server that does not declare payloads as `payload_of` makes them: bytes of another meaning may
// decode to ids. An index in memory declares nothing, and has no writers in other processes.
inline void check_encoding(const Index &index) {
    const PayloadEncoding declared = index.payload_encoding();
    if (declared == PayloadEncoding::edges || !index.status()) {
        return;
    }
    const std::string found = declared == PayloadEncoding::none ? "nothing about its payloads" : "weighted edges";
    throw ompl::Exception("wayfold: a roadmap needs an index that was created with wayfold::PayloadEncoding::edges "
                          "(on the command line, --payloads edges); this one declares " + found);
}

// Refuses what `payload_of` does not make: other programs store payloads too, and nobody has checked edges for these.
inline std::vector<std::uint64_t> edges_of(std::uint64_t id, const std::string &payload) {
    const auto refuse = [id](const std::string &problem) {
        throw ompl::Exception("wayfold: point " + std::to_string(id) + " is no vertex of a roadmap: its payload " + problem);
    };
    if (payload.size() % 8 != 0) {
        refuse("has " + std::to_string(payload.size()) + " bytes, and ids have eight each");
    }
    std::vector<std::uint64_t> ids(payload.size() / 8, 0);
    for (std::size_t at = 0; at < payload.size(); at++) {
        ids[at / 8] |= static_cast<std::uint64_t>(static_cast<unsigned char>(payload[at])) << (8 * (at % 8));
    }
    if (std::adjacent_find(ids.begin(), ids.end(), std::greater_equal<>()) != ids.end()) {
        refuse("names ids that do not ascend");
    }
    if (std::binary_search(ids.begin(), ids.end(), id)) {
        refuse("names the point itself");
    }
    if (!ids.empty() && ids.back() >> 63 != 0) {
        refuse("names " + std::to_string(ids.back()) + ", and ids are below 2^63");
    }
    return ids;
}

// The changes since a revision; all points without one, or if the index has forgotten some of the changes. `known` are
// the ids that the caller has, as the keys of a map.
template <class Known>
Changes changes_after(const Index &index, const std::optional<std::uint64_t> &since, const Known &known) {
    std::optional<Changes> changes = since ? index.changes(*since) : std::nullopt;
    if (changes) {
        return std::move(*changes);
    }
    // The revision comes first: what changes during the scan is read again.
    const std::optional<Changes> newest = index.changes(~std::uint64_t{0});
    Changes all{index.scan(), {}, newest ? newest->read_revision : 0};
    std::unordered_set<std::uint64_t> stored;
    for (const StoredPoint &point : all.stored) {
        stored.insert(point.id);
    }
    for (const auto &[id, value] : known) {
        if (stored.count(id) == 0) {
            all.removed.push_back(id);
        }
    }
    return all;
}

// Samplers that note the thread which samples. They allocate the space's own with the first sample, as late as PRM does.
class MarkingValidSampler : public ompl::base::ValidStateSampler {
public:
    MarkingValidSampler(const ompl::base::SpaceInformation *si, std::atomic<std::thread::id> &thread)
        : ValidStateSampler(si), thread_(thread) {}

    bool sample(ompl::base::State *state) override { return marked().sample(state); }
    bool sampleNear(ompl::base::State *state, const ompl::base::State *near, double distance) override {
        return marked().sampleNear(state, near, distance);
    }

private:
    ValidStateSampler &marked() {
        thread_ = std::this_thread::get_id();
        if (sampler_ == nullptr) {
            sampler_ = si_->allocValidStateSampler();
        }
        return *sampler_;
    }

    ompl::base::ValidStateSamplerPtr sampler_;
    std::atomic<std::thread::id> &thread_;
};

class MarkingSampler : public ompl::base::StateSampler {
public:
    MarkingSampler(const ompl::base::SpaceInformation *si, std::atomic<std::thread::id> &thread)
        : StateSampler(si->getStateSpace().get()), si_(si), thread_(thread) {}

    // The next sample is from a new sampler of the space.
    void clear() { sampler_.reset(); }
    void sampleUniform(ompl::base::State *state) override { marked().sampleUniform(state); }
    void sampleUniformNear(ompl::base::State *state, const ompl::base::State *near, double distance) override {
        marked().sampleUniformNear(state, near, distance);
    }
    void sampleGaussian(ompl::base::State *state, const ompl::base::State *mean, double deviation) override {
        marked().sampleGaussian(state, mean, deviation);
    }

private:
    StateSampler &marked() {
        thread_ = std::this_thread::get_id();
        if (sampler_ == nullptr) {
            sampler_ = si_->allocStateSampler();
        }
        return *sampler_;
    }

    const ompl::base::SpaceInformation *si_;
    ompl::base::StateSamplerPtr sampler_;
    std::atomic<std::thread::id> &thread_;
};

// The roadmap as OMPL's nearest neighbours: PRM's strategies search it, and PRM adds each vertex to it once the vertex
// has its edges.
template <class Roadmap> class RoadmapNeighbors : public ompl::NearestNeighbors<ompl::geometric::PRM::Vertex> {
    using Vertex = ompl::geometric::PRM::Vertex;

public:
    explicit RoadmapNeighbors(Roadmap &roadmap) : roadmap_(roadmap) {}

    bool reportsSortedResults() const override { return true; }
    // The planner forgets its vertices itself.
    void clear() override {}
    void add(const Vertex &vertex) override { roadmap_.add(vertex); }
    void add(const std::vector<Vertex> &vertices) override {
        for (const Vertex vertex : vertices) {
            add(vertex);
        }
    }
    bool remove(const Vertex &) override {
        throw ompl::Exception("wayfold: vertices of a shared roadmap stay; remove points from the index, and clear");
    }
    Vertex nearest(const Vertex &vertex) const override {
        std::vector<Vertex> found;
        nearestK(vertex, 1, found);
        if (found.empty()) {
            throw ompl::Exception("No elements found in nearest neighbors data structure");
        }
        return found[0];
    }
    void nearestK(const Vertex &vertex, std::size_t k, std::vector<Vertex> &found) const override {
        // PRM* has k = 0 for the first vertex of its graph. It searches all the same: the index tells of vertices that
        // others store meanwhile only if there was a search.
        const auto most = std::clamp<std::size_t>(k, 1, std::numeric_limits<std::uint32_t>::max());
        roadmap_.search(vertex, Search::k(static_cast<std::uint32_t>(most)), found);
        if (k == 0) {
            found.clear();
        }
    }
    // The closed ball.
    void nearestR(const Vertex &vertex, double radius, std::vector<Vertex> &found) const override {
        found.clear();
        if (radius >= 0) {
            roadmap_.search(vertex, Search::within(radius), found);
        }
    }
    std::size_t size() const override { return roadmap_.milestoneCount(); }
    void list(std::vector<Vertex> &found) const override {
        found.resize(size());
        for (std::size_t at = 0; at < found.size(); at++) {
            found[at] = at;
        }
    }

private:
    Roadmap &roadmap_;
};

} // namespace wayfold::detail
