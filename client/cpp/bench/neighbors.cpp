// Searches and inserts without a planner.
#include "clock.hpp"
#include "race.hpp"
#include "spaces.hpp"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <ompl/datastructures/NearestNeighborsGNATNoThreadSafety.h>
#include <string>
#include <vector>
#include <wayfold/ompl.hpp>

namespace {

using State = ob::State *;

std::vector<State> sample(const Problem &problem, std::size_t count) {
    const auto sampler = problem.si->allocStateSampler();
    std::vector<State> states;
    for (std::size_t at = 0; at < count; at++) {
        states.push_back(problem.si->allocState());
        sampler->sampleUniform(states.back());
    }
    return states;
}

void fail(const char *problem) {
    std::fprintf(stderr, "%s\n", problem);
    std::exit(1);
}

double ask(const ompl::NearestNeighbors<State> &structure, const std::vector<State> &queries, std::size_t k) {
    std::vector<State> found;
    const double began = own_seconds();
    for (const State query : queries) {
        structure.nearestK(query, k, found);
        if (found.size() != std::min(k, structure.size())) {
            fail("an answer has another number of neighbours");
        }
    }
    return (own_seconds() - began) / static_cast<double>(queries.size());
}

void print_list(const char *name, const std::vector<double> &values, const char *end) {
    std::printf("\"%s\": [", name);
    for (std::size_t at = 0; at < values.size(); at++) {
        std::printf("%s%.9g", at == 0 ? "" : ", ", values[at]);
    }
    std::printf("]%s", end);
}

std::string summary(std::vector<double> times) {
    std::sort(times.begin(), times.end());
    const auto at = [&](double share) { return times[static_cast<std::size_t>(share * static_cast<double>(times.size() - 1))]; };
    char text[160];
    std::snprintf(text, sizeof text, "{\"p50\": %.9f, \"p99.9\": %.9f, \"max\": %.9f}", at(0.5), at(0.999), times.back());
    return text;
}

std::vector<double> read_rows(const char *path) {
    std::vector<double> numbers;
    std::FILE *file = std::fopen(path, "rb");
    if (file == nullptr) {
        fail("the file of rows cannot be opened");
    }
    double number;
    while (std::fread(&number, sizeof number, 1, file) == 1) {
        numbers.push_back(number);
    }
    std::fclose(file);
    return numbers;
}

} // namespace

int many_neighbors(int count, char **arguments) {
    if (count != 4) {
        std::fputs("neighbors POINTS K QUERIES ROUNDS\n", stderr);
        return 2;
    }
    const std::size_t points = std::stoul(arguments[0]), k = std::stoul(arguments[1]);
    ompl::RNG::setSeed(1);
    const Problem problem = se3_in(std::make_shared<SE3>());
    ompl::NearestNeighborsGNATNoThreadSafety<State> gnat;
    gnat.setDistanceFunction([&](const State &a, const State &b) { return problem.si->distance(a, b); });
    wayfold::NearestNeighborsWayfold<State> wayfold(wayfold::detail::context_of(problem.si));
    for (const State state : sample(problem, points)) {
        gnat.add(state);
        wayfold.add(state);
    }
    wait_for_merges();
    const auto queries = sample(problem, std::stoul(arguments[2]));
    std::vector<State> ours, theirs;
    for (const State query : queries) {
        wayfold.nearestK(query, k, ours);
        gnat.nearestK(query, k, theirs);
        if (ours != theirs) {
            fail("GNAT and Wayfold find other neighbours");
        }
    }
    std::vector<double> gnat_times, wayfold_times;
    for (int round = 0; round < std::stoi(arguments[3]); round++) {
        gnat_times.push_back(ask(gnat, queries, k));
        wayfold_times.push_back(ask(wayfold, queries, k));
    }
    std::printf("{");
    print_list("gnat", gnat_times, ", ");
    print_list("wayfold", wayfold_times, "}\n");
    return 0;
}

int inserts(int count, char **arguments) {
    if (count != 2) {
        std::fputs("inserts POINTS background|inline\n", stderr);
        return 2;
    }
    ompl::RNG::setSeed(1);
    const Problem problem = se3_in(std::make_shared<SE3>());
    auto context = wayfold::detail::context_of(problem.si);
    context.merging = std::string(arguments[1]) == "inline" ? wayfold::Merging::in_line : wayfold::Merging::background;
    const auto states = sample(problem, std::stoul(arguments[0]));
    wayfold::NearestNeighborsWayfold<State> wayfold(context);
    std::vector<double> own(states.size()), wall(states.size());
    for (std::size_t at = 0; at < states.size(); at++) {
        const double wall_began = wall_seconds(), own_began = own_seconds();
        wayfold.add(states[at]);
        own[at] = own_seconds() - own_began;
        wall[at] = wall_seconds() - wall_began;
    }
    std::printf("{\"own\": %s, \"wall\": %s}\n", summary(own).c_str(), summary(wall).c_str());
    return 0;
}

int rows(int count, char **arguments) {
    if (count != 3) {
        std::fputs("rows FILE POINTS K\n", stderr);
        return 2;
    }
    const auto numbers = read_rows(arguments[0]);
    const std::size_t points = std::stoul(arguments[1]);
    const auto k = static_cast<std::uint32_t>(std::stoul(arguments[2]));
    const auto index = wayfold::Index::in_memory("R3*SO3:0.15", wayfold::Merging::in_line);
    const std::size_t width = index.width();
    const std::size_t queries = numbers.size() / width - points;
    for (std::size_t at = 0; at < points; at++) {
        index.insert(numbers.data() + at * width);
    }
    const wayfold::Search search = wayfold::Search::k(k);
    std::vector<std::uint64_t> ids;
    std::vector<double> distances;
    std::uint64_t sum = 0;
    const double began = own_seconds();
    for (std::size_t at = points; at < points + queries; at++) {
        if (k == 1) {
            sum = sum * 31 + index.nearest(numbers.data() + at * width)->id;
            continue;
        }
        const std::size_t found = index.search_into(numbers.data() + at * width, search, ids, &distances);
        for (std::size_t neighbor = 0; neighbor < found; neighbor++) {
            sum = sum * 31 + ids[neighbor];
        }
    }
    const double took = own_seconds() - began;
    std::printf("{\"seconds\": %.9g, \"sum\": \"%llu\"}\n", took / static_cast<double>(queries),
                static_cast<unsigned long long>(sum));
    return 0;
}
