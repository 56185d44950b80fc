// The shared and the remote form, against a server, which is stopped for a while, and against one with TLS, whose
// certificates and keys are in a folder: served URI PROCESS HTTPS_URI FOLDER.
#include "check.hpp"
#include "process.hpp"

#include <algorithm>
#include <fstream>
#include <functional>
#include <iterator>
#include <numeric>
#include <optional>
#include <random>
#include <string>
#include <vector>
#include <wayfold/wayfold.hpp>

namespace {

// A token, or a certificate of the client, and the certificate of the server's authority.
void guarded(const std::string &uri, const std::string &folder) {
    const auto file = [&](const std::string &name) {
        std::ifstream opened(folder + "/" + name);
        CHECK(opened.good());
        return std::string(std::istreambuf_iterator<char>(opened), {});
    };
    const std::string ca = file("ca.pem");
    const auto by_token = wayfold::Credentials().ca_certificate(ca).token("a-token-that-may-write");
    const auto by_certificate =
        wayfold::Credentials().ca_certificate(ca).client_certificate(file("planner.pem"), file("planner.key"));
    for (const auto &credentials : {by_token, by_certificate}) {
        const auto shared = wayfold::Index::shared(uri, "guarded", "R2", credentials);
        const auto id = shared.insert({1, 2});
        shared.flush();
        CHECK(wayfold::Index::remote(uri, "guarded", "", credentials).nearest({1, 2})->distance == 0 && shared.remove(id));
        CHECK(shared.close(60000).empty());
    }
    const auto code_of = [&](const wayfold::Credentials &credentials) {
        try {
            wayfold::Index::remote(uri, "guarded", "", credentials);
        } catch (const wayfold::Error &error) {
            return error.code();
        }
        return WAYFOLD_CODE_OK;
    };
    CHECK(code_of(wayfold::Credentials().ca_certificate(ca)) == WAYFOLD_CODE_UNAUTHENTICATED);
    CHECK(code_of(wayfold::Credentials().ca_certificate(ca).token("of-nobody")) == WAYFOLD_CODE_UNAUTHENTICATED);
    CHECK(code_of(wayfold::Credentials().token("a-token-that-may-write")) == WAYFOLD_CODE_INVALID_ARGUMENT);
}

// In an outage an insert of many rows stores as many as it has reserved ids for. The error tells them, so that the caller
// repeats only the others.
void partial(const std::string &uri, pid_t server) {
    const auto index = wayfold::Index::shared(uri, "outage", "R1", {}, 3000);
    std::vector<double> states(100000);
    std::iota(states.begin(), states.end(), 0.0);
    index.insert(std::vector<double>{-1});
    stop(server);
    std::optional<wayfold::Error> error;
    try {
        index.insert_many(states.data(), states.size());
    } catch (const wayfold::Error &thrown) {
        error = thrown;
    }
    CHECK(error && error->code() == WAYFOLD_CODE_DEADLINE_EXCEEDED && error->reason() == "PARTIAL");
    const std::size_t done = error->rows_done();
    CHECK(done > 0 && done < states.size() && index.size() == 1 + done);
    CHECK(std::string(error->what()).find("of 100000 took effect") != std::string::npos && error->ids().size() == done);
    for (std::size_t row = 0; row < done; row++) {
        CHECK(index.get(error->ids()[row])->state[0] == states[row]);
    }
    go_on(server);
    index.flush_within(60000);
    const auto remote = wayfold::Index::remote(uri, "outage");
    CHECK(remote.insert_many(states.data() + done, states.size() - done).size() == states.size() - done);
    CHECK(remote.size() == 1 + states.size() && index.close(60000).empty());
    // Another error changed nothing.
    try {
        index.insert_many(states.data(), states.size());
        CHECK(false);
    } catch (const wayfold::Error &closed) {
        CHECK(closed.reason() == "CLOSED" && closed.rows_done() == 0 && closed.ids().empty());
    }
}

// In a forked process each call of a shared index fails, also those that tell of its writes and answers.
void forked(const wayfold::Index &shared) {
    const std::vector<std::function<void()>> calls{
        [&] { shared.size(); },        [&] { shared.flush(); },     [&] { shared.pending(); },
        [&] { shared.take_unsent(); }, [&] { shared.meanwhile(); }, [&] { shared.meanwhile(1); },
        [&] { shared.close(0); },      [&] { shared.payload_encoding(); },
    };
    const pid_t child = fork();
    CHECK(child >= 0);
    if (child == 0) {
        int failed = 0;
        for (const auto &call : calls) {
            try {
                call();
            } catch (const wayfold::Error &error) {
                failed += error.reason() == "FORKED";
            }
        }
        _exit(failed == static_cast<int>(calls.size()) ? 0 : 1);
    }
    int status = 1;
    CHECK(waitpid(child, &status, 0) == child && status == 0);
    CHECK(shared.status()->name == WAYFOLD_STATUS_FOLLOWING);
}

} // namespace

int main(int count, char **arguments) {
    CHECK(count == 5);
    const std::string uri = arguments[1];
    const pid_t server = std::stoi(arguments[2]);
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
    forked(shared);

    const auto remote = wayfold::Index::remote(uri, "cell", {}, {}, 0, true);
    same(remote);
    const auto id = remote.insert({1, 2, 3}, 9, "by another");
    // No id is given twice.
    CHECK(id > 499);
    CHECK(remote.payload(id) == "by another" && remote.get(id)->tag == 9);
    CHECK(remote.payloads({id, 1, 900000})[0] == "by another" && !remote.payloads({900000})[0]);
    // The index tells later of a point that another process stored before an own one, if the insert could not see it.
    std::vector<std::uint64_t> near;
    const std::vector<double> here{1, 2, 3};
    const auto own = shared.insert(here.data(), 0, "own", wayfold::Search::k(600), 600, near);
    const bool has_seen = std::find(near.begin(), near.end(), id) != near.end();
    const auto taken = shared.meanwhile(30000);
    CHECK(taken.answers.size() == 1 && taken.open == 0 && !taken.has_dropped);
    CHECK(taken.answers[0].id == own && taken.answers[0].points_before == memory.size() + 1);
    const auto &later = taken.answers[0].neighbors;
    CHECK(later.size() == (has_seen ? 0 : 1) && (has_seen || later[0].id == id) && near.size() >= memory.size());
    CHECK(shared.payloads({own, id, 900000}) ==
          (std::vector<std::optional<std::string>>{"own", "by another", std::nullopt}));
    CHECK(shared.space() == remote.space() && shared.space() == memory.space());
    CHECK(remote.replace(id, {2, 2, 2}) && remote.get(id)->state[0] == 2);

    const auto missing = message_of<wayfold::Error>([&] { wayfold::Index::remote(uri, "missing"); });
    CHECK(missing.find("missing") != std::string::npos);
    // The field of an address that is none, and the one that the server refuses.
    const auto field_of = [](const std::string &address, const std::string &name) {
        try {
            wayfold::Index::remote(address, name, "R3");
        } catch (const wayfold::Error &error) {
            return error.field();
        }
        return std::string("no error");
    };
    CHECK(field_of("ftp://127.0.0.1:1", "cell") == "uri" && field_of(uri, "No name") == "name");
    const auto other = message_of<wayfold::Error>([&] { wayfold::Index::shared(uri, "cell", "R3"); });
    CHECK(other.find("cell") != std::string::npos);
    using wayfold::NewIndex, wayfold::PayloadEncoding;
    const auto declared = wayfold::Index::remote(uri, "roadmap", NewIndex("R2", PayloadEncoding::edges));
    CHECK(declared.payload_encoding() == PayloadEncoding::edges);
    CHECK(wayfold::Index::shared(uri, "roadmap").payload_encoding() == PayloadEncoding::edges);
    CHECK(shared.payload_encoding() == PayloadEncoding::none && memory.payload_encoding() == PayloadEncoding::none);
    const auto otherwise = message_of<wayfold::Error>(
        [&] { wayfold::Index::shared(uri, "roadmap", NewIndex("R2", PayloadEncoding::weighted_edges)); });
    CHECK(otherwise.find("PAYLOAD_ENCODING_EDGES, not PAYLOAD_ENCODING_WEIGHTED_EDGES") != std::string::npos);
    CHECK(!message_of<wayfold::Error>([&] { remote.clear(); }).empty());

    // The server refuses an id that it has reserved for another session: the writes from there on come back.
    CHECK(!memory.status() && !remote.status() && shared.status()->name == WAYFOLD_STATUS_FOLLOWING);
    const auto other_session = wayfold::Index::shared(uri, "cell");
    const std::size_t before = other_session.size();
    stop(server);
    CHECK(other_session.insert({3, 2, 1}, 4, "refused", own + 1000) == own + 1000);
    CHECK(other_session.set_tag(own, 8) && other_session.replace(own, {1, 1, 1}) && other_session.set_payload(own, "later"));
    CHECK(other_session.remove(own));
    go_on(server);
    CHECK(!message_of<wayfold::Error>([&] { other_session.flush_within(60000); }).empty());
    const auto refused = other_session.status();
    CHECK(refused->name == WAYFOLD_STATUS_REFUSED && refused->why.find(std::to_string(own + 1000)) != std::string::npos);
    CHECK(!message_of<wayfold::Error>([&] { other_session.insert({0, 0, 0}); }).empty());
    const auto unsent = other_session.take_unsent();
    CHECK(unsent.size() == 5 && other_session.take_unsent().empty() && other_session.size() == before);
    CHECK(unsent[0].kind == WAYFOLD_UNSENT_KIND_PUT && unsent[0].id == own + 1000 && unsent[0].tag == 4);
    CHECK(unsent[0].state == std::vector<double>({3, 2, 1}) && unsent[0].payload == "refused");
    CHECK(unsent[1].kind == WAYFOLD_UNSENT_KIND_SET_TAG && unsent[1].id == own && unsent[1].tag == 8);
    CHECK(unsent[2].kind == WAYFOLD_UNSENT_KIND_REPLACE && unsent[2].state == std::vector<double>({1, 1, 1}));
    CHECK(unsent[3].kind == WAYFOLD_UNSENT_KIND_SET_PAYLOAD && unsent[3].payload == "later");
    CHECK(unsent[4].kind == WAYFOLD_UNSENT_KIND_REMOVE && unsent[4].state.empty());
    // It takes writes again, and `close` gives back what it could not send.
    CHECK(other_session.set_tag(own, 8));
    other_session.flush();
    CHECK(remote.get(own)->tag == 8);
    other_session.insert({3, 2, 1}, 4, "refused", own + 1000);
    const auto rest = other_session.close(60000);
    CHECK(rest.size() == 1 && rest[0].id == own + 1000);
    CHECK(other_session.status()->name == WAYFOLD_STATUS_CLOSED && remote.remove(id));

    // With the bytes of its pending writes used up, a write waits for the index's timeout.
    const auto bounded = wayfold::Index::shared(uri, "cell", {}, {}, 3000, 1);
    stop(server);
    const auto pending = bounded.insert({9, 9, 9});
    const auto waited = message_of<wayfold::Error>([&] { bounded.insert({9, 9, 8}); });
    CHECK(waited.find("write") != std::string::npos && bounded.pending() == 1);
    go_on(server);
    bounded.flush_within(60000);
    CHECK(bounded.remove(pending) && bounded.close(60000).empty());

    // A remote answer has a revision too.
    std::uint64_t read_revision = 0;
    CHECK(!remote.search({0, 0, 0}, wayfold::Search::k(1), &read_revision).empty());
    const auto fresh = remote.insert({0, 0, 0});
    const auto since = remote.search({0, 0, 0}, wayfold::Search::within(100).since(read_revision).timeout(60000));
    CHECK(since.size() == 1 && since[0].id == fresh);
    remote.remove_all();
    CHECK(remote.empty());
    CHECK(shared.close(10000).empty());
    partial(uri, server);
    guarded(arguments[3], arguments[4]);
    std::cout << "served: ok\n";
}
