// wayfold/shared_prm.hpp, against a server: shared_prm URI. The processes that grow a roadmap are this program again.
#include "check.hpp"
#include "discs.hpp"
#include "process.hpp"
#include "roadmap.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <ompl/base/samplers/UniformValidStateSampler.h>
#include <ompl/geometric/SimpleSetup.h>
#include <ompl/geometric/planners/prm/ConnectionStrategy.h>
#include <ompl/util/Console.h>
#include <set>
#include <sstream>
#include <string>
#include <vector>
#include <wayfold/ompl.hpp>
#include <wayfold/shared_prm.hpp>

using namespace roadmap;

namespace {

// A process that grows a roadmap, and prints it once the other one is ready too.
void grow(const std::string &uri, const std::string &name, unsigned int iterations, bool expands) {
    Planner planner(wayfold::Index::shared(uri, name, new_index));
    std::cout << "ready" << std::endl;
    std::string go;
    std::getline(std::cin, go);
    planner.grow(iterations);
    if (expands) {
        ob::IterationTerminationCondition counter(100);
        planner.prm->expandRoadmap(ob::PlannerTerminationCondition(counter));
    }
    planner.prm->flush();
    std::cout << discs::valid_motions << std::endl;
    std::size_t vertices = 0, edges = 0;
    std::cin >> vertices >> edges;
    catch_up(*planner.prm, vertices, edges);
    is_valid(*planner.prm);
    std::cout << graph_of(*planner.prm) << "end" << std::endl;
}

// Grows without an end, and tells how many vertices the server has at least.
void grow_on(const std::string &uri, const std::string &name) {
    Planner planner(wayfold::Index::shared(uri, name, new_index));
    for (;;) {
        planner.grow(20);
        const std::uint64_t vertices = planner.prm->milestoneCount(), pending = planner.prm->index().pending();
        std::cout << vertices - std::min(vertices, pending) << std::endl;
    }
}

// A roadmap of one process, or PRM's own.
void grow_alone(bool is_shared, bool is_star) {
    ompl::RNG::setSeed(5);
    const auto si = discs::information();
    const auto grow = [&](auto &prm) {
        prm.setProblemDefinition(discs::problem(si));
        prm.setup();
        ob::IterationTerminationCondition counter(1200);
        prm.growRoadmap(ob::PlannerTerminationCondition(counter));
        std::cout << graph_of(prm) << "end" << std::endl;
    };
    if (is_shared) {
        wayfold::SharedPRM prm(si, wayfold::Index::in_memory(space), is_star);
        grow(prm);
    } else {
        og::PRM prm(si, is_star);
        grow(prm);
    }
}

std::string graph_from(Process &process) {
    std::string graph;
    for (std::string line = process.line(); line != "end"; line = process.line()) {
        graph += line + "\n";
    }
    return graph;
}

// Two processes grow one roadmap: a third one loads it, without a check, and all have the same.
void two_processes(const std::string &uri, bool expands) {
    const std::string name = expands ? "expanded" : "grown", role = expands ? "expand" : "grow";
    Process a({uri, role, name}), b({uri, role, name});
    CHECK(a.line() == "ready" && b.line() == "ready");
    a.say("go");
    b.say("go");
    const unsigned long valid = std::stoul(a.line()) + std::stoul(b.line());

    discs::checked_states = discs::checked_motions = 0;
    Planner planner(wayfold::Index::shared(uri, name));
    planner.prm->refresh();
    CHECK(discs::checked_states == 0 && discs::checked_motions == 0);
    is_valid(*planner.prm);
    const std::string graph = graph_of(*planner.prm);
    const std::size_t vertices = count(graph, "vertex"), edges = count(graph, "edge");
    CHECK(vertices >= 400 && edges > vertices && planner.prm->index().size() == vertices);
    for (Process *process : {&a, &b}) {
        process->say(std::to_string(vertices) + " " + std::to_string(edges));
        CHECK(graph_from(*process) == graph);
        CHECK(process->status() == 0);
    }
    if (!expands) {
        // Each edge was checked by one process, once.
        CHECK(valid == edges);
    }
    std::cout << name << ": " << vertices << " vertices, " << edges << " edges\n";

    // A query on the loaded roadmap. Its start and its goal are not stored.
    const auto definition = planner.prm->getProblemDefinition();
    CHECK(planner.prm->solve(ob::timedPlannerTerminationCondition(60)) == ob::PlannerStatus::EXACT_SOLUTION);
    CHECK(definition->getSolutionPath()->check());
    planner.prm->flush();
    const auto &index = planner.prm->index();
    CHECK(index.nearest({0.5, 0.5, 0})->distance > 0 && index.nearest({9.5, 9.5, 1})->distance > 0);
    CHECK(index.size() == planner.prm->milestoneCount() - 2);
    // A second one: the states of the first stay in this graph alone.
    planner.prm->setProblemDefinition(discs::problem(planner.si));
    CHECK(planner.prm->solve(ob::timedPlannerTerminationCondition(60)) == ob::PlannerStatus::EXACT_SOLUTION);
    planner.prm->flush();
    CHECK(index.size() == planner.prm->milestoneCount() - 4);
    // The planner forgets its graph, and loads the roadmap again; the index keeps it.
    const std::string before = graph_of(*planner.prm);
    planner.prm->clear();
    CHECK(planner.prm->milestoneCount() == 0 && index.size() == count(before, "vertex"));
    planner.prm->refresh();
    CHECK(graph_of(*planner.prm) == before && planner.prm->milestoneCount() == index.size());
}

// Without obstacles and with at most k vertices, each pair is an edge: no process misses a vertex that another one
// stores at the same time.
void no_missed_edge(const std::string &uri) {
    for (int round = 0; round < 10; round++) {
        const std::string name = "pairs-" + std::to_string(round);
        Planner a(wayfold::Index::shared(uri, name, new_index)), b(wayfold::Index::shared(uri, name));
        for (Planner *planner : {&a, &b}) {
            planner->si->setMotionValidator(std::make_shared<discs::AllMotions>(planner->si));
            planner->prm->setMaxNearestNeighbors(20);
        }
        for (int vertex = 0; vertex < 5; vertex++) {
            a.grow(1);
            b.grow(1);
        }
        a.prm->flush();
        b.prm->flush();
        for (Planner *planner : {&a, &b}) {
            catch_up(*planner->prm, 10, 45);
            CHECK(planner->prm->milestoneCount() == 10 && planner->prm->edgeCount() == 45);
        }
    }
}

// A process that is killed leaves no edge to a vertex that is not there, and only valid ones.
void killed(const std::string &uri) {
    for (int round = 0; round < 4; round++) {
        Process process({uri, "on", "killed"});
        const unsigned long enough = 100 * (round + 1);
        while (std::stoul(process.line()) < enough) {
        }
        process.kill();
        const auto index = wayfold::Index::shared(uri, "killed");
        std::set<std::uint64_t> ids;
        for (const auto &point : index.scan()) {
            ids.insert(point.id);
        }
        CHECK(ids.size() >= enough);
        for (const std::uint64_t id : ids) {
            for (const std::uint64_t other : wayfold::detail::edges_of(id, *index.payload(id))) {
                CHECK(ids.count(other) == 1);
            }
        }
        Planner planner(index);
        planner.prm->refresh();
        CHECK(planner.prm->milestoneCount() == ids.size());
        is_valid(*planner.prm);
    }
}

void alone() {
    for (const std::string star : {"", "star"}) {
        Process shared({"alone", "shared" + star}), plain({"alone", "plain" + star});
        // PRM's vertices are numbered as the index numbers its points.
        const std::string graph = graph_from(shared);
        CHECK(count(graph, "vertex") == 600 && graph == graph_from(plain));
        CHECK(shared.status() == 0 && plain.status() == 0);
    }
}

// Start and goal states of a query get edges to vertices of other processes that arrive later, and a connection
// strategy within a radius works as well.
void queries_and_strategies(const std::string &uri) {
    Planner a(wayfold::Index::shared(uri, "queries", new_index)), b(wayfold::Index::shared(uri, "queries"));
    for (Planner *planner : {&a, &b}) {
        const auto &near = planner->prm->getNearestNeighbors();
        planner->prm->setConnectionStrategy([near, found = std::vector<og::PRM::Vertex>()](og::PRM::Vertex at) mutable
                                            -> const std::vector<og::PRM::Vertex> & {
            near->nearestR(at, 1.5, found);
            return found;
        });
    }
    CHECK(a.prm->solve(ob::timedPlannerTerminationCondition(0.0)) != ob::PlannerStatus::EXACT_SOLUTION);
    b.grow(1500);
    b.prm->flush();
    const std::size_t vertices = b.prm->milestoneCount(), edges = b.prm->edgeCount();
    catch_up(*a.prm, vertices + 2, edges);
    is_valid(*a.prm);
    // Both ends are connected, though this process has sampled nothing since.
    CHECK(a.prm->edgeCount() > edges + 1);
    CHECK(a.prm->solve(ob::timedPlannerTerminationCondition(60)) == ob::PlannerStatus::EXACT_SOLUTION);
}

void refusals(const std::string &uri) {
    const auto si = discs::information();
    const auto other_space = wayfold::Index::shared(uri, "other-space", "R3");
    refuses<ompl::Exception>("the index has the space R3", [&] { wayfold::SharedPRM(si, other_space); });
    const auto index = wayfold::Index::shared(uri, "refusals", new_index), remote = wayfold::Index::remote(uri, "refusals");
    refuses<ompl::Exception>("not a remote one", [&] { wayfold::SharedPRM(si, remote); });
    // Without a problem definition an edge has no cost.
    wayfold::SharedPRM undefined(si, wayfold::Index::in_memory(space));
    refuses<ompl::Exception>("problem definition", [&] { undefined.growRoadmap(0.01); });

    // A point that is no vertex.
    const auto foreign = index.insert({0.1, 0.1, 0}, 0, "abc");
    Planner planner(index);
    refuses<ompl::Exception>("is no vertex of a roadmap", [&] { planner.prm->refresh(); });
    refuses<ompl::Exception>("is no vertex of a roadmap", [&] { planner.grow(10); });
    CHECK(index.remove(foreign));
    planner.prm->clear();
    planner.grow(100);
    planner.prm->flush();
    CHECK(planner.prm->milestoneCount() == 100 && index.size() == 100);

    // Another program removes a vertex.
    CHECK(remote.remove(*planner.prm->id(7)));
    index.flush();
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(60);
    while (index.size() == 100) {
        CHECK(std::chrono::steady_clock::now() < end);
    }
    refuses<ompl::Exception>("was removed from the index", [&] { planner.prm->refresh(); });
    planner.prm->clear();
    planner.prm->refresh();
    CHECK(planner.prm->milestoneCount() == 99);
    is_valid(*planner.prm);

    // Another program moves a vertex that the planner has loaded, or one that it has stored.
    for (const bool is_own : {false, true}) {
        planner.grow(is_own ? 1 : 0);
        const std::size_t vertices = planner.prm->milestoneCount();
        const std::uint64_t moved = *planner.prm->id(is_own ? vertices - 1 : 0);
        index.flush();
        std::vector<double> place = index.get(moved)->state;
        place[0] += 0.01;
        CHECK(remote.replace(moved, place));
        while (index.get(moved)->state[0] != place[0]) {
            CHECK(std::chrono::steady_clock::now() < end);
        }
        refuses<ompl::Exception>("was moved in the index", [&] { planner.prm->refresh(); });
        CHECK(remote.remove(moved));
        while (index.get(moved)) {
            CHECK(std::chrono::steady_clock::now() < end);
        }
        planner.prm->clear();
        planner.prm->refresh();
        CHECK(planner.prm->milestoneCount() == vertices - 1);
        is_valid(*planner.prm);
    }

    // The index takes no more writes: growing ends with its error, and so does each further call.
    CHECK(index.close(10000).empty());
    refuses<wayfold::Error>("closed", [&] { planner.prm->growRoadmap(30.0); });
    refuses<wayfold::Error>("closed", [&] { planner.prm->refresh(); });
    planner.prm->clear();
    refuses<wayfold::Error>("closed", [&] { planner.grow(5); });

    // The distance of this space is not that of the text.
    const auto rows = [](const ob::State *state, double *row) {
        const auto &pose = *state->as<discs::Pose>();
        row[0] = 2 * pose.getX();
        row[1] = pose.getY();
        row[2] = pose.getYaw();
    };
    const auto states = [](const double *row, ob::State *state) {
        state->as<discs::Pose>()->setXY(row[0] / 2, row[1]);
        state->as<discs::Pose>()->setYaw(row[2]);
    };
    wayfold::SharedPRM stretched(si, wayfold::Index::in_memory(space), rows, states);
    stretched.setProblemDefinition(discs::problem(si));
    refuses<ompl::Exception>("distance of two states", [&] { stretched.growRoadmap(30.0); });
}

// Grown through a reference to og::PRM, the planner stores its vertices too, also after `clear`. It takes the samplers that
// the space has when it grows.
void through_prm() {
    const auto index = wayfold::Index::in_memory(space);
    Planner planner(index);
    og::PRM &prm = *planner.prm;
    for (int round = 0; round < 2; round++) {
        const std::size_t before = index.size();
        int samplers = 0;
        prm.clear();
        planner.si->setValidStateSamplerAllocator([&](const ob::SpaceInformation *si) {
            samplers++;
            return std::make_shared<ob::UniformValidStateSampler>(si);
        });
        ob::IterationTerminationCondition counter(200), again(100);
        prm.growRoadmap(ob::PlannerTerminationCondition(counter));
        CHECK(samplers == 1 && index.size() == before + 100);
        prm.expandRoadmap(ob::PlannerTerminationCondition(again));
        planner.prm->refresh();
        CHECK(index.size() > before + 100 && index.size() == planner.prm->milestoneCount());
        is_valid(*planner.prm);
    }
}

// A strategy may ask for all vertices.
void all_neighbors() {
    Planner planner(wayfold::Index::in_memory(space));
    const auto &near = planner.prm->getNearestNeighbors();
    planner.prm->setConnectionStrategy([near, found = std::vector<og::PRM::Vertex>()](og::PRM::Vertex at) mutable
                                       -> const std::vector<og::PRM::Vertex> & {
        near->nearestK(at, SIZE_MAX, found);
        return found;
    });
    planner.grow(20);
    CHECK(planner.prm->index().size() == 20);
}

// The planner makes the index, of the space that it flattens itself; client/cpp/check looks at what it declares.
void by_name(const std::string &uri) {
    const auto si = discs::information();
    wayfold::SharedPRM planner(si, uri, "by-name");
    planner.setProblemDefinition(discs::problem(si));
    planner.growRoadmap(0.1);
    planner.flush();
    CHECK(planner.milestoneCount() > 0);
    CHECK(wayfold::Index::remote(uri, "by-name", space).size() == planner.milestoneCount());
}

// In SimpleSetup, with functions that write and read the rows.
void simple_setup(const std::string &uri) {
    og::SimpleSetup setup(discs::information());
    const auto problem = discs::problem(setup.getSpaceInformation());
    setup.setStartState(ob::ScopedState<>(setup.getStateSpace(), problem->getStartState(0)));
    setup.setGoal(problem->getGoal());
    const auto planner = std::make_shared<wayfold::SharedPRM>(
        setup.getSpaceInformation(), wayfold::Index::shared(uri, "setup", new_index),
        [](const ob::State *state, double *row) {
            const auto &pose = *state->as<discs::Pose>();
            row[0] = pose.getX();
            row[1] = pose.getY();
            row[2] = pose.getYaw();
        },
        [](const double *row, ob::State *state) {
            state->as<discs::Pose>()->setXY(row[0], row[1]);
            state->as<discs::Pose>()->setYaw(row[2]);
        });
    setup.setPlanner(planner);
    CHECK(setup.solve(60) == ob::PlannerStatus::EXACT_SOLUTION && setup.getSolutionPath().check());
    planner->constructRoadmap(ob::timedPlannerTerminationCondition(0.7));
    planner->flush();
    is_valid(*planner);
    Planner reader(wayfold::Index::shared(uri, "setup"));
    reader.prm->refresh();
    CHECK(graph_of(*reader.prm) == graph_of(*planner));
    setup.clear();
    CHECK(planner->milestoneCount() == 0 && reader.prm->index().size() > 0);
}

} // namespace

int main(int count, char **arguments) {
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    const std::vector<std::string> words(arguments + 1, arguments + count);
    const std::string role = words.size() > 1 ? words[1] : "";
    if (words.at(0) == "alone") {
        grow_alone(role.find("shared") == 0, role.find("star") != std::string::npos);
    } else if (role == "grow" || role == "expand") {
        grow(words[0], words.at(2), 200, role == "expand");
    } else if (role == "on") {
        grow_on(words[0], words.at(2));
    } else {
        CHECK(words.size() == 1);
        alone();
        two_processes(words[0], false);
        two_processes(words[0], true);
        no_missed_edge(words[0]);
        killed(words[0]);
        queries_and_strategies(words[0]);
        refusals(words[0]);
        through_prm();
        all_neighbors();
        by_name(words[0]);
        simple_setup(words[0]);
        std::cout << "shared_prm: ok\n";
    }
}
