// The time of a planner without its neighbours: one run records the answers of the nearest-neighbour structure, and
// another gets them back without a search.
#pragma once

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <unordered_map>
#include <vector>
#include <wayfold/ompl.hpp>

namespace replay {

// The answers of all structures of a planner, in the order of the calls. An element is the number of its add. A list of
// neighbours starts with its length.
struct Answers {
    std::vector<std::uint32_t> numbers;
    std::size_t next{0};

    std::uint32_t take() {
        if (next == numbers.size()) {
            std::fputs("the planner asks more than it did in the recorded run\n", stderr);
            std::exit(1);
        }
        return numbers[next++];
    }
    void write(const char *path) const {
        std::FILE *file = std::fopen(path, "wb");
        if (file == nullptr || std::fwrite(numbers.data(), 4, numbers.size(), file) != numbers.size() ||
            std::fclose(file) != 0) {
            std::perror(path);
            std::exit(1);
        }
    }
    void read(const char *path) {
        std::FILE *file = std::fopen(path, "rb");
        if (file == nullptr || std::fseek(file, 0, SEEK_END) != 0) {
            std::perror(path);
            std::exit(1);
        }
        numbers.resize(static_cast<std::size_t>(std::ftell(file)) / 4);
        std::rewind(file);
        if (std::fread(numbers.data(), 4, numbers.size(), file) != numbers.size()) {
            std::perror(path);
            std::exit(1);
        }
        std::fclose(file);
    }
};

// OMPL makes structures without arguments: they all use this.
inline Answers answers;

constexpr std::uint32_t none = UINT32_MAX;

template <class T> class Recorder : public wayfold::NearestNeighborsWayfold<T> {
    using Base = wayfold::NearestNeighborsWayfold<T>;

public:
    using Base::add;

    void clear() override {
        Base::clear();
        numbers_.clear();
        adds_ = 0;
    }
    void add(const T &element) override {
        Base::add(element);
        numbers_[element] = adds_++;
    }
    bool remove(const T &element) override {
        const bool removed = Base::remove(element);
        answers.numbers.push_back(removed ? numbers_.at(element) : none);
        return removed;
    }
    T nearest(const T &element) const override {
        const T found = Base::nearest(element);
        answers.numbers.push_back(numbers_.at(found));
        return found;
    }
    void nearestK(const T &element, std::size_t k, std::vector<T> &found) const override {
        Base::nearestK(element, k, found);
        record(found);
    }
    void nearestR(const T &element, double radius, std::vector<T> &found) const override {
        Base::nearestR(element, radius, found);
        record(found);
    }

private:
    void record(const std::vector<T> &found) const {
        answers.numbers.push_back(static_cast<std::uint32_t>(found.size()));
        for (const T &element : found) {
            answers.numbers.push_back(numbers_.at(element));
        }
    }

    std::unordered_map<T, std::uint32_t> numbers_;
    std::uint32_t adds_{0};
};

template <class T> class Replay : public ompl::NearestNeighbors<T> {
public:
    using ompl::NearestNeighbors<T>::add;

    bool reportsSortedResults() const override { return true; }
    void clear() override {
        elements_.clear();
        is_stored_.clear();
        size_ = 0;
    }
    void add(const T &element) override {
        elements_.push_back(element);
        is_stored_.push_back(true);
        size_++;
    }
    bool remove(const T &) override {
        const std::uint32_t number = answers.take();
        if (number == none) {
            return false;
        }
        is_stored_[number] = false;
        size_--;
        return true;
    }
    T nearest(const T &) const override { return elements_[answers.take()]; }
    void nearestK(const T &, std::size_t, std::vector<T> &found) const override { take(found); }
    void nearestR(const T &, double, std::vector<T> &found) const override { take(found); }
    std::size_t size() const override { return size_; }
    void list(std::vector<T> &found) const override {
        found.clear();
        for (std::size_t at = 0; at < elements_.size(); at++) {
            if (is_stored_[at]) {
                found.push_back(elements_[at]);
            }
        }
    }

private:
    void take(std::vector<T> &found) const {
        found.resize(answers.take());
        for (T &element : found) {
            element = elements_[answers.take()];
        }
    }

    std::vector<T> elements_;
    std::vector<bool> is_stored_;
    std::size_t size_{0};
    // GNAT and Wayfold draw a seed each: without this one, the planner's samplers would get other seeds.
    ompl::RNG generator_;
};

} // namespace replay
