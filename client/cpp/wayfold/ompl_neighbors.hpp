// Wayfold's index behind OMPL's interface of nearest-neighbour structures. wayfold/ompl.hpp includes it.
#pragma once

#include <wayfold/ompl_space.hpp>
#include <wayfold/wayfold.hpp>

#include <ompl/base/SpaceInformation.h>
#include <ompl/datastructures/NearestNeighbors.h>
#include <ompl/util/Exception.h>
#include <ompl/util/RandomNumbers.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <memory>
#include <string>
#include <type_traits>
#include <typeinfo>
#include <unordered_map>
#include <utility>
#include <vector>

namespace wayfold {

namespace detail {

// The space and the vertices of a planner. A structure reads them when it is made, because OMPL's setNearestNeighbors
// passes no arguments.
struct Context {
    std::string text;
    // Null if `custom` writes the rows.
    std::shared_ptr<const OmplSpace> space;
    StateToRow custom;
    ompl::base::SpaceInformationPtr information;
    // The state of a roadmap's vertex: a pointer to the vertex, of this type.
    std::function<const ompl::base::State *(const void *)> vertex;
    const std::type_info *vertex_type{nullptr};
    Merging merging{Merging::background};

    void write(const ompl::base::State *state, double *row) const {
        if (space != nullptr) {
            space->write(state, row);
        } else {
            custom(state, row);
        }
    }
};

inline Context context_of(const ompl::base::SpaceInformationPtr &information) {
    Context context;
    context.space = std::make_shared<OmplSpace>(information->getStateSpace());
    context.text = context.space->text();
    context.information = information;
    return context;
}

inline thread_local const Context *context = nullptr;

// Offers a context to the structures that this thread makes within the scope.
class Scope {
public:
    explicit Scope(const Context &offered) : before_(context) { context = &offered; }
    ~Scope() { context = before_; }
    Scope(const Scope &) = delete;
    Scope &operator=(const Scope &) = delete;

private:
    const Context *before_;
};

template <class T, class = void> struct HasState : std::false_type {};
template <class T>
struct HasState<T, std::enable_if_t<std::is_convertible_v<decltype(std::declval<T>()->state), const ompl::base::State *>>>
    : std::true_type {};
template <class T, class = void> struct HasStateField : std::false_type {};
template <class T>
struct HasStateField<
    T, std::enable_if_t<std::is_convertible_v<decltype(std::declval<T>()->state_), const ompl::base::State *>>>
    : std::true_type {};
template <class T, class = void> struct IsHashable : std::false_type {};
template <class T>
struct IsHashable<T, std::void_t<decltype(std::hash<T>()(std::declval<const T &>()))>> : std::true_type {};

} // namespace detail

// The nearest-neighbour structure. It copies the rows of elements when they are added: an element whose state changes
// later is found where it was, and can still be removed. Searches may run at once; changes may not, as in OMPL's own.
template <typename T> class NearestNeighborsWayfold : public ompl::NearestNeighbors<T> {
    using Base = ompl::NearestNeighbors<T>;

public:
    // For OMPL's setNearestNeighbors, which passes no arguments: call wayfold::use.
    NearestNeighborsWayfold() : NearestNeighborsWayfold(offered()) {}

    explicit NearestNeighborsWayfold(const detail::Context &context)
        : context_(context), index_(Index::in_memory(context.text, context.merging)) {
        if constexpr (!reads_state) {
            if (context.vertex_type == nullptr || *context.vertex_type != typeid(T)) {
                throw ompl::Exception("wayfold: elements of this type have no state; use the constructor that takes a "
                                      "space text and a function that writes an element's row");
            }
        }
        if (context.space != nullptr && context.space->width() != index_.width()) {
            throw ompl::Exception("wayfold: the rows of " + context.text + " have another width");
        }
        // PRM and LazyPRM set no distance function, and a connection strategy of theirs calls it.
        if (context.information != nullptr) {
            Base::setDistanceFunction([this](const T &a, const T &b) {
                return context_.information->distance(state_of(a), state_of(b));
            });
        }
    }

    NearestNeighborsWayfold(const NearestNeighborsWayfold &) = delete;
    NearestNeighborsWayfold &operator=(const NearestNeighborsWayfold &) = delete;

    // For elements of your own: a space text, and a function that writes an element's row. If you set OMPL's distance, the
    // weights of rotations should sum to less than 2.2: without OMPL's space, the check of the distance does not know them.
    NearestNeighborsWayfold(const std::string &space, std::function<void(const T &, double *)> write,
                            Merging merging = Merging::background)
        : write_(std::move(write)), index_(Index::in_memory(space, merging)) {
        context_.text = space;
    }

    bool reportsSortedResults() const override { return true; }

    void setDistanceFunction(const typename Base::DistanceFunction &distance) override {
        Base::setDistanceFunction(distance);
        unchecked_ = checked_adds;
    }

    // Forgets its own elements, and does not read them: planners free the states before.
    void clear() override {
        index_.clear();
        first_ += elements_.size();
        elements_.clear();
        is_stored_.clear();
        ids_.clear();
        has_ids_ = false;
        size_ = 0;
    }

    void add(const T &element) override {
        double row[max_width];
        write(element, row);
        if (unchecked_ > 0 && Base::distFun_) {
            check_distance(element, row);
        }
        const std::size_t at = elements_.size();
        elements_.push_back(element);
        try {
            is_stored_.push_back(true);
            if constexpr (detail::IsHashable<T>::value) {
                if (has_ids_) {
                    ids_.emplace(element, at);
                }
            }
            // The index comes last: its ids are the places, and it gives none of them twice.
            index_.insert(row);
        } catch (...) {
            elements_.pop_back();
            is_stored_.resize(at);
            // The next `remove` makes the table again.
            ids_.clear();
            has_ids_ = false;
            throw;
        }
        size_++;
    }

    void add(const std::vector<T> &elements) override {
        for (const T &element : elements) {
            add(element);
        }
    }

    bool remove(const T &element) override {
        const std::size_t at = find(element);
        if (at == elements_.size()) {
            return false;
        }
        index_.remove(first_ + at);
        is_stored_[at] = false;
        size_--;
        // The place stays; what the element owns does not.
        if constexpr (std::is_default_constructible_v<T> && std::is_move_assignable_v<T>) {
            elements_[at] = T();
        }
        return true;
    }

    T nearest(const T &element) const override {
        if (size_ == 0) {
            throw ompl::Exception("No elements found in nearest neighbors data structure");
        }
        double row[max_width];
        write(element, row);
        return elements_[index_.nearest(row)->id - first_];
    }

    void nearestK(const T &element, std::size_t k, std::vector<T> &found) const override {
        found.clear();
        if (k > 0 && size_ > 0) {
            search(element, Search::k(static_cast<std::uint32_t>(std::min(k, size_))), found);
        }
    }

    // The closed ball.
    void nearestR(const T &element, double radius, std::vector<T> &found) const override {
        found.clear();
        if (radius >= 0 && size_ > 0) {
            search(element, Search::within(radius), found);
        }
    }

    std::size_t size() const override { return size_; }

    void list(std::vector<T> &found) const override {
        found.clear();
        found.reserve(size_);
        for (std::size_t at = 0; at < elements_.size(); at++) {
            if (is_stored_[at]) {
                found.push_back(elements_[at]);
            }
        }
    }

private:
    static constexpr bool is_state = std::is_convertible_v<T, const ompl::base::State *>;
    static constexpr bool reads_state = is_state || detail::HasState<T>::value || detail::HasStateField<T>::value;
    // A space has at most this many coordinates.
    static constexpr std::size_t max_width = 256;
    static constexpr unsigned int checked_adds = 32;

    static const detail::Context &offered() {
        if (detail::context == nullptr) {
            throw ompl::Exception("wayfold: this structure needs the planner's space; call wayfold::use(planner) in "
                                  "place of planner.setNearestNeighbors");
        }
        return *detail::context;
    }

    const ompl::base::State *state_of(const T &element) const {
        if constexpr (is_state) {
            return element;
        } else if constexpr (detail::HasState<T>::value) {
            return element->state;
        } else if constexpr (detail::HasStateField<T>::value) {
            return element->state_;
        } else {
            return context_.vertex(&element);
        }
    }

    void write(const T &element, double *row) const {
        if (write_) {
            write_(element, row);
        } else {
            context_.write(state_of(element), row);
        }
    }

    void search(const T &element, const Search &search, std::vector<T> &found) const {
        thread_local std::vector<std::uint64_t> ids;
        double row[max_width];
        write(element, row);
        const std::size_t count = index_.search_into(row, search, ids);
        found.reserve(count);
        for (std::size_t at = 0; at < count; at++) {
            found.push_back(elements_[ids[at] - first_]);
        }
    }

    // The place of a stored element, or the number of places.
    std::size_t find(const T &element) {
        if constexpr (detail::IsHashable<T>::value) {
            // Planners that never remove do not pay for the table.
            if (!has_ids_) {
                // An exception may have left a part of it.
                ids_.clear();
                for (std::size_t at = 0; at < elements_.size(); at++) {
                    if (is_stored_[at]) {
                        ids_.emplace(elements_[at], at);
                    }
                }
                has_ids_ = true;
            }
            const auto entry = ids_.find(element);
            if (entry == ids_.end()) {
                return elements_.size();
            }
            const std::size_t at = entry->second;
            ids_.erase(entry);
            return at;
        } else {
            std::size_t at = 0;
            while (at < elements_.size() && !(is_stored_[at] && elements_[at] == element)) {
                at++;
            }
            return at;
        }
    }

    // Compares our distance with the planner's.
    void check_distance(const T &element, const double *row) {
        unchecked_--;
        const auto *space = context_.information != nullptr ? context_.information->getStateSpace().get() : nullptr;
        double other_row[max_width];
        unsigned int left = 8;
        for (std::size_t at = elements_.size(); at > 0 && left > 0; at--) {
            if (!is_stored_[at - 1]) {
                continue;
            }
            left--;
            const T &other = elements_[at - 1];
            write(other, other_row);
            detail::check_distance(index_.distance(other_row, row), Base::distFun_(other, element), context_.text, space);
        }
    }

    detail::Context context_;
    std::function<void(const T &, double *)> write_;
    Index index_;
    // By id, from the id `first_` on; those that are removed keep their places.
    std::vector<T> elements_;
    std::vector<bool> is_stored_;
    std::uint64_t first_{0};
    std::size_t size_{0};
    std::conditional_t<detail::IsHashable<T>::value, std::unordered_multimap<T, std::size_t>, std::vector<T>> ids_;
    bool has_ids_{false};
    unsigned int unchecked_{checked_adds};
    // OMPL's GNAT has a generator, which draws one of the process's seeds. Without this one, the planner's samplers would
    // get other seeds than with GNAT.
    ompl::RNG generator_;
};

} // namespace wayfold
