// Processor time: of this thread, and of the threads that merge.
#pragma once

#include <ctime>
#include <dirent.h>
#include <fstream>
#include <string>
#include <unistd.h>

inline double seconds(clockid_t clock) {
    timespec time{};
    clock_gettime(clock, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

inline double own_seconds() { return seconds(CLOCK_THREAD_CPUTIME_ID); }
inline double wall_seconds() { return seconds(CLOCK_MONOTONIC); }
inline double other_seconds() { return seconds(CLOCK_PROCESS_CPUTIME_ID) - own_seconds(); }

// True if another thread of this process runs or waits for a processor.
inline bool others_run() {
    bool run = false;
    if (DIR *tasks = opendir("/proc/self/task")) {
        while (const dirent *task = readdir(tasks)) {
            if (task->d_name[0] == '.' || std::stoi(task->d_name) == getpid()) {
                continue;
            }
            std::ifstream stat(std::string("/proc/self/task/") + task->d_name + "/stat");
            std::string text((std::istreambuf_iterator<char>(stat)), {});
            const std::size_t name = text.rfind(") ");
            run = run || (name != std::string::npos && text[name + 2] == 'R');
        }
        closedir(tasks);
    }
    return run;
}

// Waits for the merges that are under way. One thread wakes another: each look must find both at rest.
inline void wait_for_merges() {
    for (int quiet = 0; quiet < 3; quiet = others_run() ? 0 : quiet + 1) {
        usleep(1000);
    }
}
