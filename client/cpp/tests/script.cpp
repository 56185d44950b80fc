// Replays the script of operations in each form and compares the answers: script FILE URI.
#include "check.hpp"

#include <cinttypes>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <functional>
#include <optional>
#include <sstream>
#include <string>
#include <vector>
#include <wayfold/wayfold.hpp>

namespace {

using Words = std::istringstream;
using State = std::vector<double>;
using Make = std::function<wayfold::Index(const std::string &space, const std::string &name)>;

constexpr std::uint64_t MAX_WAIT_MS = 30000;

std::string word(Words &words) {
    std::string text;
    CHECK(words >> text);
    return text;
}

std::uint64_t integer(Words &words) { return std::stoull(word(words)); }

// std::stod reads NaN and infinity, which streams do not.
double number(Words &words) { return std::stod(word(words)); }

State rest(Words &words) {
    State state;
    for (std::string text; words >> text;) {
        state.push_back(std::stod(text));
    }
    return state;
}

std::string bits(double number) {
    std::uint64_t bits = 0;
    std::memcpy(&bits, &number, sizeof bits);
    char text[17];
    std::snprintf(text, sizeof text, "%016" PRIx64, bits);
    return text;
}

std::string joined(const std::vector<std::string> &words) {
    std::string text;
    for (const auto &word : words) {
        text += text.empty() ? word : " " + word;
    }
    return text.empty() ? "none" : text;
}

std::string text(bool done) { return done ? "true" : "false"; }

std::string text(const std::vector<wayfold::Neighbor> &neighbors) {
    std::vector<std::string> words;
    for (const auto &near : neighbors) {
        words.push_back(std::to_string(near.id) + ":" + bits(near.distance));
    }
    return joined(words);
}

std::string insert_many(const wayfold::Index &index, Words &words) {
    const std::size_t count = integer(words);
    const State states = rest(words);
    CHECK(states.size() == count * index.width());
    std::vector<std::string> ids;
    for (const auto id : index.insert_many(states.data(), count)) {
        ids.push_back(std::to_string(id));
    }
    return joined(ids);
}

std::string get(const wayfold::Index &index, std::uint64_t id) {
    const auto point = index.get(id);
    if (!point) {
        return "none";
    }
    CHECK(point->id == id);
    std::vector<std::string> words{std::to_string(point->tag)};
    for (const auto number : point->state) {
        words.push_back(bits(number));
    }
    return joined(words);
}

std::string search(const wayfold::Index &index, Words &words) {
    const auto k = word(words);
    const auto radius = number(words);
    const auto mask = integer(words), value = integer(words);
    const auto epsilon = number(words);
    const auto state = rest(words);
    auto search = wayfold::Search::within(radius);
    if (k != "-") {
        search = wayfold::Search::k(static_cast<std::uint32_t>(std::stoul(k))).radius(radius);
    }
    return text(index.search(state, search.tag(mask, value).epsilon(epsilon)));
}

std::string answer(const wayfold::Index &index, Words &words) {
    const auto name = word(words);
    if (name == "insert") {
        return std::to_string(index.insert(rest(words)));
    }
    if (name == "insert_with") {
        const auto id = word(words);
        const auto tag = integer(words);
        const auto state = rest(words);
        return std::to_string(id == "-" ? index.insert(state, tag) : index.insert(state, tag, {}, std::stoull(id)));
    }
    if (name == "insert_many") {
        return insert_many(index, words);
    }
    if (name == "replace") {
        const auto id = integer(words);
        return text(index.replace(id, rest(words)));
    }
    if (name == "remove") {
        return text(index.remove(integer(words)));
    }
    if (name == "set_tag") {
        const auto id = integer(words);
        return text(index.set_tag(id, integer(words)));
    }
    if (name == "get") {
        return get(index, integer(words));
    }
    if (name == "len") {
        return std::to_string(index.size());
    }
    if (name == "nearest") {
        const auto nearest = index.nearest(rest(words));
        return nearest ? text(std::vector<wayfold::Neighbor>{*nearest}) : "none";
    }
    if (name == "nearest_k") {
        const auto k = static_cast<std::uint32_t>(integer(words));
        return text(index.nearest_k(rest(words), k));
    }
    if (name == "nearest_r") {
        const auto radius = number(words);
        return text(index.nearest_r(rest(words), radius));
    }
    CHECK(name == "search");
    return search(index, words);
}

// The code and the message, which begins with the field.
std::string refused(const wayfold::Error &error) {
    CHECK(!error.field().empty() && !error.reason().empty());
    const std::string message = error.what();
    CHECK(message.compare(0, error.field().size(), error.field()) == 0);
    CHECK(error.code() == WAYFOLD_CODE_INVALID_ARGUMENT || error.code() == WAYFOLD_CODE_ALREADY_EXISTS);
    const bool is_invalid = error.code() == WAYFOLD_CODE_INVALID_ARGUMENT;
    return (is_invalid ? "INVALID_ARGUMENT " : "ALREADY_EXISTS ") + message;
}

void replay(const std::string &file, const std::string &form, const Make &make) {
    std::ifstream lines(file);
    std::optional<wayfold::Index> index;
    int indices = 0, answers = 0, at = 0;
    for (std::string line; std::getline(lines, line);) {
        at++;
        if (line.empty() || line[0] == '#') {
            continue;
        }
        if (line.rfind("space ", 0) == 0) {
            if (index) {
                CHECK(index->close(MAX_WAIT_MS).empty());
            }
            index = make(line.substr(6), "script-" + form + "-" + std::to_string(++indices));
            continue;
        }
        const auto end = line.find(" = ");
        CHECK(end != std::string::npos && index);
        const auto expected = line.substr(end + 3);
        Words words(line.substr(0, end));
        std::string found;
        try {
            found = answer(*index, words);
        } catch (const wayfold::Error &error) {
            found = refused(error);
        }
        if (found != expected) {
            std::cerr << file << ":" << at << ": " << form << ": " << found << "\nwhere brute force has " << expected
                      << "\n";
            std::exit(1);
        }
        answers++;
    }
    CHECK(index && answers > 0 && index->close(MAX_WAIT_MS).empty());
    std::cout << "script: " << form << ": " << answers << " answers\n";
}

} // namespace

int main(int count, char **arguments) {
    CHECK(count == 3);
    const std::string file = arguments[1], uri = arguments[2];
    replay(file, "memory", [](const auto &space, const auto &) { return wayfold::Index::in_memory(space); });
    replay(file, "inline", [](const auto &space, const auto &) {
        return wayfold::Index::in_memory(space, wayfold::Merging::in_line);
    });
    replay(file, "shared",
           [&](const auto &space, const auto &name) { return wayfold::Index::shared(uri, name, space); });
    replay(file, "remote",
           [&](const auto &space, const auto &name) { return wayfold::Index::remote(uri, name, space); });
}
