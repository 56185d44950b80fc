/* A disk that fails and comes back, put before a program by LD_PRELOAD.
 *
 *   FAILING_DISK     a directory, as an absolute path without links; only files under it fail
 *   FAILING_CONTROL  a file, not under it: while it exists, the disk fails
 *
 * The file has one line: which calls fail, the number of errno, and optionally a part of the path to which this is
 * limited:
 *
 *   full 28             no room: making a file or a directory fails, and writing
 *   torn 28             the same, but every other write writes its first half
 *   readonly 30         opening to write or to make, writing, renaming, removing and syncing fail
 *   syncs 5             only fsync and fdatasync fail
 *   full 28 /tables/    no room for files whose path contains this
 *   large 28 1000000    little room: a write at or beyond this offset fails, unless the file is a journal (*.jnl),
 *                       whose room is taken in advance
 *
 * Each call reads the path of its descriptor, so the call that made the descriptor does not matter. Each call looks for
 * the control file, so the disk fails from the moment at which the file has its name. System calls that a program makes
 * without the C library are not caught. */

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "open.h"

enum { PATH_BYTES = 4096 };

/* The effect of a call. */
enum call { MAKES = 1, WRITES = 2, OPENS = 4, NAMES = 8, SYNCS = 16 };

static const char *root, *control;
static atomic_uint torn;

__attribute__((constructor)) static void start(void) {
    root = getenv("FAILING_DISK");
    control = getenv("FAILING_CONTROL");
}

static bool under_root(const char *path) {
    size_t length = strlen(root);
    return strncmp(path, root, length) == 0 && (path[length] == '/' || path[length] == 0);
}

struct failure {
    int number;
    bool half;
};

/* The failure of such a call at this moment, number 0 if there is none; `at` is the offset at which it writes. */
static struct failure failure(enum call call, const char *path, off_t at) {
    struct failure none = {0, false};
    int before = errno;
    if (root == NULL || control == NULL || !under_root(path)) return none;
    int fd = syscall(SYS_openat, AT_FDCWD, control, O_RDONLY | O_CLOEXEC, 0);
    errno = before;
    if (fd < 0) return none;
    char line[256] = {0}, kind[16] = {0}, part[128] = {0};
    int number = 0;
    ssize_t got = syscall(SYS_read, fd, line, sizeof line - 1);
    syscall(SYS_close, fd);
    if (got <= 0 || sscanf(line, "%15s %d %127s", kind, &number, part) < 2) abort();
    errno = before;
    if (strcmp(kind, "large") == 0) {
        bool fits = call != WRITES || at < atol(part) || strstr(path, ".jnl") != NULL;
        return fits ? none : (struct failure){number, false};
    }
    if (strstr(path, part) == NULL) return none;
    bool half = strcmp(kind, "torn") == 0;
    int failing;
    if (half || strcmp(kind, "full") == 0) failing = MAKES | WRITES;
    else if (strcmp(kind, "readonly") == 0) failing = MAKES | WRITES | OPENS | NAMES | SYNCS;
    else if (strcmp(kind, "syncs") == 0) failing = SYNCS;
    else abort();
    struct failure found = {number, half};
    return call & failing ? found : none;
}

/* The failure of a call on a descriptor; a negative `at` is the position of the descriptor. */
static struct failure failure_of(enum call call, int fd, off_t at) {
    char link[64], path[PATH_BYTES];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    int before = errno;
    ssize_t length = root == NULL ? -1 : readlink(link, path, sizeof path - 1);
    errno = before;
    if (length < 0) return (struct failure){0, false};
    path[length] = 0;
    return failure(call, path, at < 0 ? lseek64(fd, 0, SEEK_CUR) : at);
}

/* Sets errno and returns true if there is a failure. */
static bool fails(struct failure failure) {
    if (failure.number == 0) return false;
    errno = failure.number;
    return true;
}

/* The calls that are caught. Relative paths are not under the disk. */

static int opened(int at, const char *path, int flags, mode_t mode) {
    struct stat stat;
    bool writes = (flags & O_ACCMODE) != O_RDONLY;
    if (writes) {
        bool makes = flags & O_CREAT && fstatat(at, path, &stat, 0) != 0;
        if (fails(failure(makes ? MAKES : OPENS, path, 0))) return -1;
    }
    return syscall(SYS_openat, at, path, flags, mode);
}

int mkdir(const char *path, mode_t mode) {
    struct stat stat;
    /* For an existing directory, the kernel returns EEXIST. */
    bool makes = fstatat(AT_FDCWD, path, &stat, 0) != 0;
    if (makes && fails(failure(MAKES, path, 0))) return -1;
    return syscall(SYS_mkdirat, AT_FDCWD, path, mode);
}

int rename(const char *from, const char *to) {
    if (fails(failure(NAMES, to, 0))) return -1;
    return syscall(SYS_renameat2, AT_FDCWD, from, AT_FDCWD, to, 0);
}

int unlink(const char *path) {
    if (fails(failure(NAMES, path, 0))) return -1;
    return syscall(SYS_unlinkat, AT_FDCWD, path, 0);
}

/* The number of bytes to write of `length`; negative if the write fails. */
static ssize_t writable(int fd, size_t length, off_t at) {
    struct failure found = failure_of(WRITES, fd, at);
    if (found.half && length > 1 && atomic_fetch_add(&torn, 1) % 2 == 0) return length / 2;
    return fails(found) ? -1 : (ssize_t)length;
}

ssize_t write(int fd, const void *bytes, size_t length) {
    ssize_t allowed = writable(fd, length, -1);
    return allowed < 0 ? -1 : syscall(SYS_write, fd, bytes, allowed);
}

ssize_t writev(int fd, const struct iovec *parts, int count) {
    if (fails(failure_of(WRITES, fd, -1))) return -1;
    return syscall(SYS_writev, fd, parts, count);
}

ssize_t pwrite64(int fd, const void *bytes, size_t length, off64_t at) {
    ssize_t allowed = writable(fd, length, at);
    return allowed < 0 ? -1 : syscall(SYS_pwrite64, fd, bytes, allowed, at);
}

ssize_t pwrite(int fd, const void *bytes, size_t length, off_t at) { return pwrite64(fd, bytes, length, at); }

int ftruncate64(int fd, off64_t length) {
    if (fails(failure_of(WRITES, fd, 0))) return -1;
    return syscall(SYS_ftruncate, fd, length);
}

int ftruncate(int fd, off_t length) { return ftruncate64(fd, length); }

int fsync(int fd) {
    if (fails(failure_of(SYNCS, fd, 0))) return -1;
    return syscall(SYS_fsync, fd);
}

int fdatasync(int fd) {
    if (fails(failure_of(SYNCS, fd, 0))) return -1;
    return syscall(SYS_fdatasync, fd);
}
