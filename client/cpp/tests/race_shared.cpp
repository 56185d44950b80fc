// The vertices a second of a shared roadmap, grown by one process and by two, where collision checks dominate. The last
// column is the ratio that the processor time of the processes allows if nothing else uses their cores:
// race_shared URI [RUNS [SECONDS]] [--json FILE]; client/cpp/race_shared runs it.
#include "process.hpp"

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <ctime>
#include <memory>
#include <ompl/base/ProblemDefinition.h>
#include <ompl/base/ScopedState.h>
#include <ompl/base/spaces/SE3StateSpace.h>
#include <ompl/util/Console.h>
#include <random>
#include <string>
#include <utility>
#include <vector>
#include <wayfold/shared_prm.hpp>

namespace ob = ompl::base;
using Clock = std::chrono::steady_clock;

namespace {

using Point = std::array<double, 3>;

// A rod of 20 points among 400 balls: a check compares all with all until it finds a contact.
class Rod : public ob::StateValidityChecker {
public:
    explicit Rod(const ob::SpaceInformationPtr &si) : StateValidityChecker(si) {
        std::mt19937 random(1);
        std::uniform_real_distribution<double> uniform(0, 10);
        for (Point &ball : balls_) {
            ball = {uniform(random), uniform(random), uniform(random)};
        }
    }

    bool isValid(const ob::State *state) const override {
        const auto &pose = *state->as<ob::SE3StateSpace::StateType>();
        const auto &turn = pose.rotation();
        // The rod's direction is the turned x axis.
        const Point axis{1 - 2 * (turn.y * turn.y + turn.z * turn.z), 2 * (turn.x * turn.y + turn.z * turn.w),
                         2 * (turn.x * turn.z - turn.y * turn.w)};
        for (int at = -10; at < 10; at++) {
            const double along = 0.05 * at;
            const Point point{pose.getX() + along * axis[0], pose.getY() + along * axis[1], pose.getZ() + along * axis[2]};
            for (const Point &ball : balls_) {
                const double x = point[0] - ball[0], y = point[1] - ball[1], z = point[2] - ball[2];
                if (x * x + y * y + z * z < 0.16) {
                    return false;
                }
            }
        }
        return true;
    }

private:
    std::array<Point, 400> balls_;
};

ob::SpaceInformationPtr information() {
    const auto space = std::make_shared<ob::SE3StateSpace>();
    ob::RealVectorBounds bounds(3);
    bounds.setLow(0);
    bounds.setHigh(10);
    space->setBounds(bounds);
    auto si = std::make_shared<ob::SpaceInformation>(space);
    si->setStateValidityChecker(std::make_shared<Rod>(si));
    si->setStateValidityCheckingResolution(0.005);
    si->setup();
    return si;
}

// Grows a roadmap for some time, and waits until the server has it.
void grow(const std::string &uri, const std::string &name, unsigned long seed, double seconds) {
    ompl::RNG::setSeed(seed);
    const auto si = information();
    wayfold::SharedPRM planner(si, uri, name);
    const auto definition = std::make_shared<ob::ProblemDefinition>(si);
    planner.setProblemDefinition(definition);
    planner.setup();
    std::cout << "ready" << std::endl;
    std::string go;
    std::getline(std::cin, go);
    planner.growRoadmap(seconds);
    planner.flush();
    timespec time{};
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    std::cout << static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec) << std::endl;
}

// The vertices of a second, and of a second of the processes' own processor time.
struct Rates {
    double by_clock;
    double by_processor;
};

// The rates of this many processes.
Rates rates_of(const std::string &uri, unsigned int processes, int run, double seconds) {
    const std::string name = "race-" + std::to_string(processes) + "-" + std::to_string(run);
    std::vector<std::unique_ptr<Process>> growing;
    for (unsigned int number = 0; number < processes; number++) {
        const std::string seed = std::to_string(1 + 2 * static_cast<unsigned int>(run) + number);
        growing.push_back(std::make_unique<Process>(
            std::vector<std::string>{uri, "grow", name, seed, std::to_string(seconds)}));
    }
    for (const auto &process : growing) {
        CHECK(process->line() == "ready");
    }
    const auto began = Clock::now();
    for (const auto &process : growing) {
        process->say("go");
    }
    double processor = 0;
    for (const auto &process : growing) {
        processor += std::stod(process->line());
    }
    const double took = std::chrono::duration<double>(Clock::now() - began).count();
    for (const auto &process : growing) {
        CHECK(process->status() == 0);
    }
    const auto vertices = static_cast<double>(wayfold::Index::remote(uri, name).size());
    return {vertices / took, vertices / processor};
}

double median(std::vector<double> values) {
    std::sort(values.begin(), values.end());
    return values[values.size() / 2];
}

} // namespace

int main(int count, char **arguments) {
    ompl::msg::setLogLevel(ompl::msg::LOG_NONE);
    std::vector<std::string> words(arguments + 1, arguments + count);
    std::string file;
    if (words.size() > 2 && words[words.size() - 2] == "--json") {
        file = words.back();
        words.resize(words.size() - 2);
    }
    CHECK(!words.empty());
    if (words.size() == 5 && words[1] == "grow") {
        grow(words[0], words[2], std::stoul(words[3]), std::stod(words[4]));
        return 0;
    }
    const int runs = words.size() > 1 ? std::stoi(words[1]) : 5;
    const double seconds = words.size() > 2 ? std::stod(words[2]) : 5;
    std::vector<double> one, two, ratios, costs;
    for (int run = 0; run < runs; run++) {
        // In turns: each is first in half of the runs.
        std::array<Rates, 2> rates{};
        for (const int turn : {0, 1}) {
            const std::size_t at = static_cast<std::size_t>((turn + run) % 2);
            rates[at] = rates_of(words[0], static_cast<unsigned int>(at) + 1, run, seconds);
        }
        one.push_back(rates[0].by_clock);
        two.push_back(rates[1].by_clock);
        ratios.push_back(rates[1].by_clock / rates[0].by_clock);
        costs.push_back(2 * rates[1].by_processor / rates[0].by_processor);
    }
    const auto [least, most] = std::minmax_element(ratios.begin(), ratios.end());
    std::printf("| roadmap | one process | two processes | ratio | its range over %d runs | on a core for each |\n"
                "|---|---|---|---|---|---|\n",
                runs);
    std::printf("| SharedPRM, SE3, %.0f s | %.0f vertices/s | %.0f vertices/s | %.2f | %.2f to %.2f | %.2f |\n", seconds,
                median(one), median(two), median(ratios), *least, *most, median(costs));
    if (!file.empty()) {
        std::ofstream json(file);
        json << "{\"rounds\": " << runs << ", \"seconds\": " << seconds << ", \"one\": " << median(one)
             << ", \"two\": " << median(two) << ", \"ratio\": " << median(ratios) << ", \"least\": " << *least
             << ", \"most\": " << *most << ", \"on_a_core_for_each\": " << median(costs) << "}\n";
        CHECK(json.flush());
    }
}
