/* The calls that open a file. Each calls opened(), which the file that includes this defines. */

#include <fcntl.h>
#include <stdarg.h>

static int opened(int at, const char *path, int flags, mode_t mode);

#define OPEN(name)                                  \
    int name(const char *path, int flags, ...) {    \
        va_list more;                               \
        va_start(more, flags);                      \
        mode_t mode = va_arg(more, mode_t);         \
        va_end(more);                               \
        return opened(AT_FDCWD, path, flags, mode); \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                     \
    int name(int at, const char *path, int flags, ...) { \
        va_list more;                                    \
        va_start(more, flags);                           \
        mode_t mode = va_arg(more, mode_t);              \
        va_end(more);                                    \
        return opened(at, path, flags, mode);            \
    }
OPENAT(openat)
OPENAT(openat64)
