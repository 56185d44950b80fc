/* A strict disk, put before a program by LD_PRELOAD. Beside the program's files it keeps a *shadow*: what a disk would
 * hold after a loss of power at this moment.
 *
 *   POWER_DISK    a directory, as an absolute path without links; only files under it are watched
 *   POWER_SHADOW  an empty directory beside it
 *   POWER_SEED    a number: the disk also writes some data before it is asked to, in parts and in any order
 *   POWER_LOOKED  a pipe to be made, not under the disk. While readers have it open, a sync of a journal (*.jnl) lasts
 *                 until they have looked again; they write a byte for each look. So they have time to see anything that
 *                 must not be visible before the sync. (fjall blocks all readers while it syncs its tables.)
 *   POWER_FAILS   a number n: the n-th sync of a journal fails with EIO. Its data counts as clean from then on, as on
 *                 Linux, and is written only if the program writes it again. "new": the first sync of a journal that the
 *                 program has made fails
 *   POWER_CUT     a number n: the program is killed before the n-th call that makes, writes or syncs something
 *
 * Durable data:
 *   - The content of a file, as of its last fsync or fdatasync. sync_file_range does not count.
 *   - The names in a directory (created, renamed, removed), as of the last fsync of that directory: all of them, as
 *     journaling file systems do. A file's own fsync does not make its name durable: less than ext4 does, and all that
 *     POSIX promises.
 *   - Everything that existed when the program started, and everything that exists when it exits in order.
 *
 * Only the calls that make a file or a directory, write to one, or sync one are caught, because files are known by
 * their inode: descriptors may be duplicated and names changed by calls that are not seen here (rename among them: some
 * programs call the kernel directly). The functions here call the kernel directly too, so that they do not call each
 * other. */

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "open.h"
#include "shadow.h"

enum { LOOKS = 3, MAX_LOOKS_MS = 10000 };

static uint64_t journal_syncs, failing;
/* The first number of an object that the program has made itself, if the first sync of such a journal fails. */
static unsigned failing_from = UINT_MAX;
static int looked = -1;

__attribute__((constructor)) static void start(void) {
    const char *disk = getenv("POWER_DISK"), *unasked = getenv("POWER_SEED"), *pipe = getenv("POWER_LOOKED");
    const char *fails = getenv("POWER_FAILS");
    shadow = getenv("POWER_SHADOW");
    if (disk == NULL || shadow == NULL) return;
    if (getenv("POWER_CUT") != NULL) cut = strtoull(getenv("POWER_CUT"), NULL, 10);
    if (fails != NULL) failing = strtoull(fails, NULL, 10);
    if (pipe != NULL) {
        /* Fails if an earlier start of the program made the pipe. */
        mkfifo(pipe, 0600);
        looked = syscall(SYS_openat, AT_FDCWD, pipe, O_RDONLY | O_NONBLOCK | O_CLOEXEC, 0);
        if (looked < 0) trouble("cannot open the pipe", pipe);
    }
    /* An odd seed: a seed of 0 would draw 0 for ever. */
    if (unasked != NULL) seed = strtoull(unasked, NULL, 10) * 2 + 1;
    pthread_mutex_lock(&mutex);
    sync_all(disk, true);
    if (fails != NULL && strcmp(fails, "new") == 0) failing_from = numbers;
    root = disk;
    pthread_mutex_unlock(&mutex);
}

__attribute__((destructor)) static void end(void) {
    if (root == NULL) return;
    pthread_mutex_lock(&mutex);
    sync_all(root, false);
    pthread_mutex_unlock(&mutex);
}

/* The calls that are caught. */

static int opened(int at, const char *path, int flags, mode_t mode) {
    if (!watched(path)) return syscall(SYS_openat, at, path, flags, mode);
    struct stat before, stat;
    pthread_mutex_lock(&mutex);
    bool existed = fstatat(at, path, &before, 0) == 0;
    if (!existed || flags & O_TRUNC) about_to_change();
    int fd = syscall(SYS_openat, at, path, flags, mode);
    int error = errno;
    if (fd >= 0 && fstat(fd, &stat) == 0 && (S_ISREG(stat.st_mode) || S_ISDIR(stat.st_mode))) {
        struct object *object = existed ? find(&stat) : made(&stat, path);
        if (object == NULL) trouble("made by a call that is not caught", path);
        else if (object->directory) {
            free(object->path);
            object->path = strdup(path);
        } else if (flags & O_TRUNC && existed) wrote(object, 0, before.st_size);
    }
    pthread_mutex_unlock(&mutex);
    errno = error;
    return fd;
}

int mkdirat(int at, const char *path, mode_t mode) {
    struct stat stat;
    if (!watched(path)) return syscall(SYS_mkdirat, at, path, mode);
    pthread_mutex_lock(&mutex);
    about_to_change();
    int result = syscall(SYS_mkdirat, at, path, mode);
    int error = errno;
    if (result == 0 && fstatat(at, path, &stat, AT_SYMLINK_NOFOLLOW) == 0) made(&stat, path);
    pthread_mutex_unlock(&mutex);
    errno = error;
    return result;
}

int mkdir(const char *path, mode_t mode) { return mkdirat(AT_FDCWD, path, mode); }

/* Counts a call that is about to write or sync a descriptor. */
static void about_to_change_file(int fd) {
    if (lock(fd) == NULL) return;
    about_to_change();
    pthread_mutex_unlock(&mutex);
}

/* Notes a write of `bytes` that ended at the offset `end`, or at the position of the descriptor if `end` is
 * negative. */
static ssize_t written(int fd, ssize_t bytes, off_t end) {
    struct object *object = bytes > 0 ? lock(fd) : NULL;
    if (object == NULL) return bytes;
    if (end < 0) end = lseek64(fd, 0, SEEK_CUR);
    wrote(object, end - bytes, end);
    write_back(object, fd);
    pthread_mutex_unlock(&mutex);
    return bytes;
}

ssize_t write(int fd, const void *bytes, size_t length) {
    about_to_change_file(fd);
    return written(fd, syscall(SYS_write, fd, bytes, length), -1);
}

ssize_t writev(int fd, const struct iovec *parts, int length) {
    about_to_change_file(fd);
    return written(fd, syscall(SYS_writev, fd, parts, length), -1);
}

ssize_t pwrite64(int fd, const void *bytes, size_t length, off64_t at) {
    about_to_change_file(fd);
    ssize_t count = syscall(SYS_pwrite64, fd, bytes, length, at);
    return written(fd, count, at + count);
}

ssize_t pwrite(int fd, const void *bytes, size_t length, off_t at) { return pwrite64(fd, bytes, length, at); }

int ftruncate64(int fd, off64_t length) {
    struct stat before;
    struct object *object = lock(fd);
    if (object == NULL) return syscall(SYS_ftruncate, fd, length);
    fstat(fd, &before);
    about_to_change();
    int result = syscall(SYS_ftruncate, fd, length);
    int error = errno;
    /* A later write past the end fills the truncated range with zeros. */
    if (result == 0 && length < before.st_size) wrote(object, length, before.st_size);
    pthread_mutex_unlock(&mutex);
    errno = error;
    return result;
}

int ftruncate(int fd, off_t length) { return ftruncate64(fd, length); }

static bool is_journal(int fd) {
    char link[64], path[PATH_BYTES];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    return length > 4 && memcmp(path + length - 4, ".jnl", 4) == 0;
}

/* Waits for LOOKS looks, so that at least one of two readers begins and ends a look meanwhile. Returns at once if there
 * is no reader: a reader that stops looking closes the pipe. */
static void wait_for_looks(void) {
    char looks_made[256];
    ssize_t got;
    do got = syscall(SYS_read, looked, looks_made, sizeof looks_made);
    while (got > 0);
    if (got == 0) return;
    struct pollfd look = {.fd = looked, .events = POLLIN};
    for (ssize_t looks = 0; looks < LOOKS; looks += got) {
        if (poll(&look, 1, MAX_LOOKS_MS) == 0) trouble("nobody looks", "while a journal is synced");
        got = syscall(SYS_read, looked, looks_made, sizeof looks_made);
        if (got <= 0) return;
    }
}

static void about_to_sync(int fd) {
    if (lock(fd) == NULL) return;
    pthread_mutex_unlock(&mutex);
    if (looked >= 0 && is_journal(fd)) wait_for_looks();
    about_to_change_file(fd);
}

static int synced(int fd, int result) {
    bool journal = is_journal(fd);
    struct object *object = result == 0 ? lock(fd) : NULL;
    if (object == NULL) return result;
    bool fails = journal && (++journal_syncs == failing || object->number >= failing_from);
    if (fails) {
        object->ranges = 0;
        failing_from = UINT_MAX;
    } else sync_object(object, fd);
    pthread_mutex_unlock(&mutex);
    if (fails) errno = EIO;
    return fails ? -1 : 0;
}

int fsync(int fd) {
    about_to_sync(fd);
    return synced(fd, syscall(SYS_fsync, fd));
}

int fdatasync(int fd) {
    about_to_sync(fd);
    return synced(fd, syscall(SYS_fdatasync, fd));
}
