// wayfold/shared_prm.hpp, where its server stops answering, is overloaded or refuses a write: shared_prm_outages URI PROCESS.
#include "check.hpp"
#include "discs.hpp"
#include "process.hpp"
#include "roadmap.hpp"

#include <chrono>
#include <cstdint>
#include <exception>
#include <future>
#include <optional>
#include <ompl/util/Console.h>
#include <string>
#include <vector>
#include <wayfold/shared_prm.hpp>

using namespace roadmap;

namespace {

using Clock = std::chrono::steady_clock;

struct Inside : wayfold::SharedPRM {
    static auto late() { return &Inside::late_; }
    static auto reading() { return &Inside::reading_; }
};

// The server stops answering: a flush ends at its own time, and not after the hour of the index.
void flush_in_time(const std::string &uri, pid_t server) {
    Planner planner(wayfold::Index::shared(uri, "stopped", new_index, {}, 3600 * 1000));
    stop(server);
    planner.grow(50);
    refuses<wayfold::Error>("flush", [&] { planner.prm->flush(std::chrono::milliseconds(200)); });
    CHECK(planner.prm->index().pending() > 0);
    go_on(server);
    planner.prm->flush(std::chrono::milliseconds::max());
    CHECK(wayfold::Index::remote(uri, "stopped").size() == 50);
    // It waits for no neighbour that was removed before the graph had it.
    ((*planner.prm).*Inside::late()).emplace_back(*planner.prm->id(0), 1 << 30);
    planner.prm->flush(std::chrono::seconds(5));
}

// A call waits for one read of payloads while the server does not answer, also if one was under way before.
void one_wait(const std::string &uri, pid_t server) {
    Planner reader(wayfold::Index::shared(uri, "one-wait", new_index, {}, 2000));
    reader.prm->refresh();
    Planner writer(wayfold::Index::shared(uri, "one-wait"));
    writer.grow(20);
    writer.prm->flush();
    const auto end = Clock::now() + std::chrono::seconds(60);
    while (reader.prm->index().size() < 20) {
        CHECK(Clock::now() < end);
    }
    stop(server);
    for (int call = 0; call < 2; call++) {
        const auto begin = Clock::now();
        reader.prm->refresh();
        CHECK(Clock::now() - begin < std::chrono::seconds(3));
    }
    go_on(server);
    catch_up(*reader.prm, 20, writer.prm->edgeCount());
    CHECK(graph_of(*reader.prm) == graph_of(*writer.prm));
}

// The first vertices of two graphs of PRM*, for which PRM asks for no neighbours, get the edge between them.
void first_vertices(const std::string &uri, pid_t server) {
    Planner a(wayfold::Index::shared(uri, "first", new_index), true), b(wayfold::Index::shared(uri, "first"), true);
    stop(server);
    for (Planner *planner : {&a, &b}) {
        planner->si->setMotionValidator(std::make_shared<discs::AllMotions>(planner->si));
        planner->grow(1);
    }
    go_on(server);
    a.prm->flush();
    b.prm->flush();
    for (Planner *planner : {&a, &b}) {
        catch_up(*planner->prm, 2, 1);
    }
}

// Payloads that a server could not send are asked for again, unless the same call cannot succeed later.
void failed_reads() {
    struct Failure {
        wayfold_code code;
        std::string reason;
        bool may_end;
    };
    const std::vector<Failure> failures{
        {WAYFOLD_CODE_UNAVAILABLE, "", true},
        {WAYFOLD_CODE_DEADLINE_EXCEEDED, "", true},
        {WAYFOLD_CODE_INTERNAL, "", true},
        {WAYFOLD_CODE_UNKNOWN, "", true},
        {WAYFOLD_CODE_CANCELLED, "", true},
        {WAYFOLD_CODE_RESOURCE_EXHAUSTED, "OVERLOADED", true},
        {WAYFOLD_CODE_RESOURCE_EXHAUSTED, "LIMIT_EXCEEDED", false},
        {WAYFOLD_CODE_PERMISSION_DENIED, "", false},
    };
    Planner planner(wayfold::Index::in_memory(space));
    for (const Failure &failure : failures) {
        planner.prm->clear();
        planner.grow(1);
        std::promise<std::vector<std::optional<std::string>>> read;
        read.set_exception(std::make_exception_ptr(wayfold::Error(failure.code, "no payloads", "", failure.reason)));
        (*planner.prm).*Inside::reading() = read.get_future();
        if (failure.may_end) {
            planner.grow(1);
        } else {
            refuses<wayfold::Error>("no payloads", [&] { planner.grow(1); });
        }
    }
}

// Pending vertices that the server has refused are not taken for removed ones. `clear` ends the error.
void refused_write(const std::string &uri, pid_t server) {
    const auto index = wayfold::Index::shared(uri, "refused", new_index), other = wayfold::Index::shared(uri, "refused");
    const std::uint64_t reserved = other.insert({0.1, 0.1, 0}) + 1;
    other.flush();
    Planner planner(index);
    planner.grow(10);
    planner.prm->flush();
    catch_up(*planner.prm, 11, 0);
    stop(server);
    index.insert({0.1, 0.2, 0}, 0, "", reserved);
    planner.grow(10);
    go_on(server);
    const auto end = Clock::now() + std::chrono::seconds(60);
    while (index.status()->name != WAYFOLD_STATUS_REFUSED) {
        CHECK(Clock::now() < end);
    }
    const std::string refusal = std::to_string(reserved);
    refuses<wayfold::Error>(refusal, [&] { planner.prm->flush(); });
    refuses<wayfold::Error>(refusal, [&] { planner.grow(1); });
    planner.prm->clear();
    planner.grow(10);
    planner.prm->flush();
    CHECK(wayfold::Index::remote(uri, "refused").size() == 21 && planner.prm->milestoneCount() == 21);
}

} // namespace

int main(int count, char **arguments) {
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    CHECK(count == 3);
    const std::string uri = arguments[1];
    const pid_t server = std::stoi(arguments[2]);
    flush_in_time(uri, server);
    one_wait(uri, server);
    first_vertices(uri, server);
    failed_reads();
    refused_write(uri, server);
    std::cout << "shared_prm_outages: ok\n";
}
