// Other processes.
#pragma once

#include "check.hpp"

#include <csignal>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <string>
#include <sys/wait.h>
#include <unistd.h>
#include <vector>

// Stops a process for a while, and returns once none of its threads runs.
inline void stop(pid_t process) {
    CHECK(kill(process, SIGSTOP) == 0);
    for (const auto &thread : std::filesystem::directory_iterator("/proc/" + std::to_string(process) + "/task")) {
        for (std::string stat; stat.find(") T ") == std::string::npos;) {
            std::getline(std::ifstream(thread.path() / "stat"), stat);
        }
    }
}

inline void go_on(pid_t process) { CHECK(kill(process, SIGCONT) == 0); }

// This program again, as another process, with a line to it and one from it.
class Process {
public:
    explicit Process(std::vector<std::string> arguments) {
        int down[2], up[2];
        CHECK(pipe(down) == 0 && pipe(up) == 0);
        id_ = fork();
        CHECK(id_ >= 0);
        if (id_ == 0) {
            dup2(down[0], STDIN_FILENO);
            dup2(up[1], STDOUT_FILENO);
            for (const int end : {down[0], down[1], up[0], up[1]}) {
                close(end);
            }
            std::string self = "/proc/self/exe";
            std::vector<char *> words{self.data()};
            for (std::string &argument : arguments) {
                words.push_back(argument.data());
            }
            words.push_back(nullptr);
            execv(self.data(), words.data());
            _exit(127);
        }
        close(down[0]);
        close(up[1]);
        to_ = fdopen(down[1], "w");
        from_ = fdopen(up[0], "r");
    }
    Process(const Process &) = delete;
    Process &operator=(const Process &) = delete;
    ~Process() {
        if (id_ > 0) {
            kill();
        }
        std::fclose(to_);
        std::fclose(from_);
    }

    void say(const std::string &line) {
        CHECK(std::fprintf(to_, "%s\n", line.c_str()) > 0 && std::fflush(to_) == 0);
    }

    // The next line of its output; the process must not have ended.
    std::string line() {
        char *text = nullptr;
        std::size_t room = 0;
        const ssize_t bytes = getline(&text, &room, from_);
        CHECK(bytes > 0);
        std::string line(text, static_cast<std::size_t>(bytes) - 1);
        std::free(text);
        return line;
    }

    // Waits for its end.
    int status() {
        int status = 1;
        CHECK(waitpid(id_, &status, 0) == id_);
        id_ = 0;
        return status;
    }

    void kill() {
        ::kill(id_, SIGKILL);
        status();
    }

private:
    pid_t id_{0};
    FILE *to_{nullptr};
    FILE *from_{nullptr};
};
