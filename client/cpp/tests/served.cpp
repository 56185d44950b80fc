// The shared and the remote form, against a server: served URI.
#include "check.hpp"

#include <algorithm>
#include <optional>
#include <random>
#include <string>
#include <vector>
#include <wayfold/wayfold.hpp>

int main(int count, char **arguments) {
    CHECK(count == 2);
    const std::string uri = arguments[1];
    std::mt19937 random(2);
    std::uniform_real_distribution<double> uniform(-3, 3);
    const auto state = [&] { return std::vector<double>{uniform(random), uniform(random), uniform(random)}; };

    // The same operations in memory are the truth: ids and the bits of distances.
    const std::string space = "R2*SO2:0.5";
    const auto memory = wayfold::Index::in_memory(space);
    const auto shared = wayfold::Index::shared(uri, "cell", space);
    for (int at = 0; at < 500; at++) {
        const auto row = state();
        const auto id = shared.insert(row, at % 3, "payload " + std::to_string(at));
        CHECK(memory.insert(row, at % 3) == id);
        if (at % 7 == 0) {
            CHECK(shared.remove(id / 2) == memory.remove(id / 2));
        }
    }
    const auto same = [&](const wayfold::Index &index) {
        for (int round = 0; round < 100; round++) {
            const auto query = state();
            CHECK(index.nearest_k(query, 10) == memory.nearest_k(query, 10));
            const auto tagged = wayfold::Search::k(5).tag(3, 1);
            CHECK(index.search(query, tagged) == memory.search(query, tagged));
        }
        CHECK(index.nearest_r({0, 0, 0}, 1.5) == memory.nearest_r({0, 0, 0}, 1.5));
        CHECK(index.size() == memory.size());
    };
    same(shared);
    shared.flush();
    CHECK(shared.pending() == 0);

    const auto remote = wayfold::Index::remote(uri, "cell");
    same(remote);
    const auto id = remote.insert({1, 2, 3}, 9, "by another");
    // No id is given twice.
    CHECK(id > 499);
    CHECK(remote.payload(id) == "by another" && remote.get(id)->tag == 9);
    CHECK(remote.payloads({id, 1, 900000})[0] == "by another" && !remote.payloads({900000})[0]);
    // What another stores before an own point is told later, if the point's insert could not see it.
    std::vector<std::uint64_t> near;
    const std::vector<double> here{1, 2, 3};
    const auto own = shared.insert(here.data(), 0, "own", wayfold::Search::k(600), 600, near);
    const bool has_seen = std::find(near.begin(), near.end(), id) != near.end();
    const auto told = shared.meanwhile(30000);
    CHECK(told.answers.size() == 1 && told.open == 0 && !told.has_dropped);
    CHECK(told.answers[0].id == own && told.answers[0].points_before == memory.size() + 1);
    const auto &later = told.answers[0].neighbors;
    CHECK(later.size() == (has_seen ? 0 : 1) && (has_seen || later[0].id == id) && near.size() >= memory.size());
    CHECK(shared.payloads({own, id, 900000}) ==
          (std::vector<std::optional<std::string>>{"own", "by another", std::nullopt}));
    CHECK(shared.space() == remote.space() && shared.space() == memory.space());
    CHECK(remote.replace(id, {2, 2, 2}) && remote.get(id)->state[0] == 2);

    const auto missing = message_of<wayfold::Error>([&] { wayfold::Index::remote(uri, "missing"); });
    CHECK(missing.find("missing") != std::string::npos);
    const auto other = message_of<wayfold::Error>([&] { wayfold::Index::shared(uri, "cell", "R3"); });
    CHECK(other.find("cell") != std::string::npos);
    CHECK(!message_of<wayfold::Error>([&] { remote.clear(); }).empty());
    CHECK(shared.close(10000) == 0);
    std::cout << "served: ok\n";
}
