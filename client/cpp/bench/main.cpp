// The programs of client/cpp/race.
#include "race.hpp"

#include <cstdio>
#include <cstring>
#include <ompl/util/Console.h>

int main(int count, char **arguments) {
    ompl::msg::setLogLevel(ompl::msg::LOG_ERROR);
    const struct {
        const char *name;
        int (*run)(int, char **);
    } programs[] = {{"plan", plan}, {"neighbors", many_neighbors}, {"inserts", inserts}, {"rows", rows}};
    for (const auto &program : programs) {
        if (count > 1 && std::strcmp(arguments[1], program.name) == 0) {
            return program.run(count - 2, arguments + 2);
        }
    }
    std::fputs("client/cpp/race starts this program\n", stderr);
    return 2;
}
