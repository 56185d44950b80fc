// Ends the program if a condition does not hold.
#pragma once

#include <cstdlib>
#include <iostream>
#include <string>

#define CHECK(condition)                                                                                               \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            std::cerr << __FILE__ << ":" << __LINE__ << ": " << #condition << "\n";                                    \
            std::exit(1);                                                                                              \
        }                                                                                                              \
    } while (0)

// The message of the exception that `action` throws.
template <class Exception, class Action> std::string message_of(Action action) {
    try {
        action();
    } catch (const Exception &error) {
        return error.what();
    }
    std::cerr << "no exception\n";
    std::exit(1);
}

// `action` throws an exception whose message has this sentence.
template <class Exception, class Action> void refuses(const std::string &sentence, Action action) {
    const std::string message = message_of<Exception>(action);
    if (message.find(sentence) == std::string::npos) {
        std::cerr << "expected: " << sentence << "\nfound: " << message << "\n";
        std::exit(1);
    }
}
