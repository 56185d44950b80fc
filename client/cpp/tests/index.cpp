// wayfold.hpp: answers against brute force, errors, and threads.
#include "check.hpp"

#include <algorithm>
#include <cmath>
#include <random>
#include <string>
#include <thread>
#include <wayfold/wayfold.hpp>

int main() {
    std::mt19937 random(1);
    std::uniform_real_distribution<double> uniform(-1, 1);
    const auto state = [&] {
        return std::vector<double>{uniform(random), uniform(random), uniform(random), 0.1, 0.2, 0.3, 0.9};
    };
    const auto pose = [&] {
        std::vector<double> row = state();
        double norm = 0;
        for (int at = 3; at < 7; at++) {
            row[at] = uniform(random);
            norm += row[at] * row[at];
        }
        for (int at = 3; at < 7; at++) {
            row[at] /= std::sqrt(norm);
        }
        return row;
    };
    const auto index = wayfold::Index::in_memory("sum(R3, SO3)");
    CHECK(index.width() == 7 && index.empty() && !index.nearest(pose()));
    std::vector<std::vector<double>> rows;
    for (int at = 0; at < 2000; at++) {
        rows.push_back(pose());
        CHECK(index.insert(rows.back()) == static_cast<std::uint64_t>(at));
    }
    for (int round = 0; round < 50; round++) {
        const auto query = pose();
        std::vector<wayfold::Neighbor> all;
        for (std::size_t at = 0; at < rows.size(); at++) {
            all.push_back({at, index.distance(query.data(), rows[at].data())});
        }
        std::sort(all.begin(), all.end(), [](const auto &a, const auto &b) { return a.distance < b.distance; });
        const auto near = index.nearest_k(query, 20);
        CHECK(near.size() == 20 && std::equal(near.begin(), near.end(), all.begin()));
        CHECK(*index.nearest(query) == all[0]);
        const auto within = index.nearest_r(query, all[300].distance);
        CHECK(within.size() == 301 && std::equal(within.begin(), within.end(), all.begin()));
    }
    const auto wrong = message_of<wayfold::Error>([&] { index.insert({1, 2}); });
    CHECK(wrong.find("states[0]") != std::string::npos);
    CHECK(message_of<wayfold::Error>([&] { wayfold::Index::in_memory("R"); }).find("column") != std::string::npos);

    const auto id = index.insert(pose(), 5, std::string(1000, 'x'));
    CHECK(index.get(id)->tag == 5 && index.payload(id) == std::string(1000, 'x') && !index.get(id + 1));
    // No payload is another answer than no point.
    CHECK(index.payload(0) == "" && !index.payload(id + 1));
    // No given id stands for one that the index assigns.
    for (const std::uint64_t wrong : {UINT64_MAX, std::uint64_t{1} << 63}) {
        refuses<wayfold::Error>("id: " + std::to_string(wrong) + "; ids are below 2^63",
                                [&] { index.insert(pose(), 0, "", wrong); });
    }
    CHECK(index.search(pose(), wayfold::Search::k(3).tag(~0ULL, 5)).size() == 1);
    const auto changes = index.changes(0);
    CHECK(changes && changes->stored.size() == 2001);
    CHECK(index.remove(id) && !index.remove(id) && index.changes(changes->read_revision)->removed.size() == 1);
    CHECK(index.scan().size() == 2000);

    // A later search finds only the points that an earlier search or insert has not seen.
    std::uint64_t read_revision = 0, later = 0;
    CHECK(index.search(pose(), wayfold::Search::k(1), &read_revision).size() == 1);
    std::vector<std::uint64_t> near;
    const auto row = pose();
    std::vector<double> apart;
    const auto fresh = index.insert(row.data(), 0, "", wayfold::Search::k(1), 1, near, &later, &apart, 9000);
    CHECK(fresh == 9000 && apart == std::vector<double>{index.distance(row.data(), rows[near[0]].data())});
    const auto since = index.search(row, wayfold::Search::within(100).since(read_revision));
    CHECK(since.size() == 1 && since[0].id == fresh && near.size() == 1 && near[0] != fresh);
    CHECK(index.search(row, wayfold::Search::within(100).since(later)).empty() && index.remove(fresh));
    CHECK(index.search(row, wayfold::Search::k(2).timeout(60000)) == index.nearest_k(row, 2));
    CHECK(wayfold::Search::k(2).timeout(7).raw().timeout_ms == 7);
    CHECK(message_of<wayfold::Error>([] { wayfold::Search::k(1).timeout(0); }).find("timeout") == 0);

    // Many states in a call have the answers of each alone.
    std::vector<double> queries;
    for (int at = 0; at < 20; at++) {
        queries.insert(queries.end(), rows[at].begin(), rows[at].end());
    }
    using wayfold::Search;
    for (const auto &search : {Search::k(3), Search::k(50), Search::within(1), Search::within(0)}) {
        std::uint64_t seen = 0;
        const auto answers = index.search_many(queries.data(), 20, search, &seen);
        CHECK(answers.size() == 20 && answers[0].front().distance == 0);
        CHECK(index.search(rows[0], wayfold::Search::k(1).since(seen)).empty());
        for (int at = 0; at < 20; at++) {
            CHECK(answers[at] == index.search(rows[at], search));
        }
    }
    CHECK(index.search_many(nullptr, 0, wayfold::Search::k(1)).empty());
    std::vector<std::uint64_t> no_ids;
    std::vector<double> no_numbers;
    std::vector<std::size_t> no_counts;
    index.nearest_k(no_numbers.data(), 0, 1, no_ids.data(), no_numbers.data(), no_counts.data());
    CHECK(index.insert_many(no_numbers.data(), 0).empty());

    // Factors: 0 is the nearest one and the radius 0, and a negative one is refused.
    CHECK(index.search(rows[3], wayfold::Search::k_factor(0)) == index.nearest_k(rows[3], 1));
    CHECK(index.search(rows[3], wayfold::Search::k_factor(2)).size() == 16);  // ⌈2 ln 2000⌉
    CHECK(index.search(rows[3], wayfold::Search::within(100).radius_factor(0)) == index.nearest_r(rows[3], 0));
    CHECK(message_of<wayfold::Error>([] { wayfold::Search::k_factor(-1); }).find("k_factor") == 0);
    CHECK(message_of<wayfold::Error>([] { wayfold::Search::k(1).radius_factor(-1); }).find("radius_factor") == 0);
    CHECK(message_of<wayfold::Error>([&] { index.search(rows[3], wayfold::Search::k_factor(NAN)); }).find("NaN") !=
          std::string::npos);

    // The literal 0 is a state, not a null pointer, and no number is no state.
    const auto line = wayfold::Index::in_memory("R1");
    CHECK(line.insert({0}) == 0 && line.nearest({0})->distance == 0 && line.nearest_k({0}, 1)[0].id == 0);
    refuses<wayfold::Error>("states[0]: 0 numbers", [&] { line.nearest({}); });

    // The neighbours of one state take no room in the answers of others, which would be 20 GB here.
    const std::vector<double> crowd(12000, 5.0);
    line.insert_many(crowd.data(), crowd.size());
    std::vector<double> apart_from_it(100000, 9.0);
    apart_from_it[7] = 5.0;
    const auto uneven = line.search_many(apart_from_it.data(), apart_from_it.size(), wayfold::Search::within(1));
    CHECK(uneven.size() == 100000 && uneven[6].empty() && uneven[7].size() == 12000 && uneven[8].empty());

    // Searches beside inserts, merges on their own thread.
    std::thread inserts([&] {
        for (int round = 0; round < 5; round++) {
            for (const auto &row : rows) {
                index.insert(row);
            }
        }
    });
    for (int round = 0; round < 500; round++) {
        CHECK(index.nearest_k(rows[round], 5)[0].distance == 0);
    }
    inserts.join();
    CHECK(index.size() == 12000);

    // 2,000 searches for 12,000 points each take far longer than a millisecond.
    queries.clear();
    for (const auto &row : rows) {
        queries.insert(queries.end(), row.begin(), row.end());
    }
    try {
        index.search_many(queries.data(), rows.size(), wayfold::Search::within(100).timeout(1));
        CHECK(false);
    } catch (const wayfold::Error &error) {
        CHECK(error.code() == WAYFOLD_CODE_DEADLINE_EXCEEDED && error.reason() == "SEARCH_TIMEOUT");
        CHECK(error.field() == "timeout");
    }
    index.remove_all();
    CHECK(index.empty() && index.insert(rows[0]) >= 12000);
    std::cout << "index: ok\n";
}
