/* A strict disk, put before a program by LD_PRELOAD: beside the program's files it keeps a *shadow* with what a disk
 * would hold after a loss of power at this very moment.
 *
 *   POWER_DISK    a directory, as an absolute path without links; only what is under it is watched
 *   POWER_SHADOW  an empty directory beside it
 *   POWER_SEED    a number: the disk also writes some of what it was not asked to, in parts and in any order
 *   POWER_LOOKED  a pipe to be made, not under the disk: while readers have it open, the sync of a journal (*.jnl) lasts
 *                 until they have looked again, of which they tell by a byte. So there is time to see what must not be
 *                 seen before. (While it syncs its tables fjall lets nobody read from them.)
 *   POWER_FAILS   a number: of the syncs of a journal, the one that fails, with EIO. What it was to write is taken for
 *                 clean from then on, as Linux does, and is written only if a program writes it again
 *   POWER_CUT     a number: of the calls that make, write or sync something, the one before which the program is killed
 *
 * What is durable:
 *   - The content of a file, as of the last fsync or fdatasync of it. sync_file_range does not count.
 *   - The names in a directory (created, renamed, removed), as of the last fsync of that directory: all of them, as
 *     journaling file systems do. A file's own fsync does not make its name durable: less than ext4 does, and all that
 *     POSIX promises.
 *   - What was there when the program started, and everything once it has ended in order.
 *
 * The shadow holds a file for each file and directory that there ever was, named by a number; one that is missing is
 * empty. Under a directory's number there is its listing, a line for each name: "f" or "d", a number, the name. It is
 * replaced as a whole. The number of the root is 0, and before that is there the program has not begun. If something went
 * on behind the back of this file it is told in "trouble".
 *
 * Files are known by their inode, not by their descriptor or name. So descriptors may be duplicated and names changed
 * by calls that are not seen here (rename among them: some programs call the kernel directly); only what makes a file
 * or a directory, writes to one, or syncs one must be caught. To the kernel everything here speaks directly, too, and
 * so does not call itself. */

#define _GNU_SOURCE
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "open.h"

enum { SECTOR = 512, PATH_BYTES = 4096, LOOKS = 3, MOST_MS = 10000 };

struct range {
    off_t start, end;
};

/* A file or a directory under the root. */
struct object {
    dev_t device;
    ino_t inode;
    unsigned number;
    bool directory;
    /* Of a directory: where it was opened last. */
    char *path;
    /* Of a file: what was written since it was synced. */
    struct range *dirty;
    size_t ranges;
};

/* Guards all below, and the shadow. */
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static const char *root, *shadow;
static struct object *objects;
static size_t count;
static unsigned numbers;
static uint64_t seed, calls, cut, journal_syncs, failing;
static int looked = -1;

/* What a test must know of. */
static void trouble(const char *what, const char *where) {
    char path[PATH_BYTES];
    snprintf(path, sizeof path, "%s/trouble", shadow);
    FILE *file = fopen(path, "a");
    if (file == NULL) abort();
    fprintf(file, "%s: %s\n", what, where);
    fclose(file);
}

static uint64_t draw(uint64_t below) {
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return seed % below;
}

static int shadow_file(unsigned number, const char *ending, int flags) {
    char path[PATH_BYTES];
    snprintf(path, sizeof path, "%s/%u%s", shadow, number, ending);
    int fd = syscall(SYS_openat, AT_FDCWD, path, flags | O_CREAT | O_CLOEXEC, 0600);
    if (fd < 0) trouble("cannot write the shadow", path);
    return fd;
}

static bool watched(const char *path) {
    size_t length = root == NULL ? 0 : strlen(root);
    return length > 0 && strncmp(path, root, length) == 0 && (path[length] == '/' || path[length] == 0);
}

static struct object *find(const struct stat *stat) {
    for (size_t i = count; i-- > 0;) {
        if (objects[i].inode == stat->st_ino && objects[i].device == stat->st_dev) return &objects[i];
    }
    return NULL;
}

/* Takes note of what was just made. An inode may have had another life: what is in the shadow of that one stays under
 * its number, for as long as a listing names it. */
static struct object *made(const struct stat *stat, const char *path) {
    struct object *object = find(stat);
    if (object == NULL) {
        objects = realloc(objects, (count + 1) * sizeof *objects);
        if (objects == NULL) abort();
        object = &objects[count++];
    } else {
        free(object->path);
        free(object->dirty);
    }
    *object = (struct object){.device = stat->st_dev, .inode = stat->st_ino, .number = numbers++};
    object->directory = S_ISDIR(stat->st_mode);
    object->path = object->directory ? strdup(path) : NULL;
    return object;
}

static void wrote(struct object *object, off_t start, off_t end) {
    for (size_t i = 0; i < object->ranges; i++) {
        struct range *range = &object->dirty[i];
        if (start <= range->end && end >= range->start) {
            if (start < range->start) range->start = start;
            if (end > range->end) range->end = end;
            return;
        }
    }
    object->dirty = realloc(object->dirty, (object->ranges + 1) * sizeof *object->dirty);
    if (object->dirty == NULL) abort();
    object->dirty[object->ranges++] = (struct range){start, end};
}

static void copy(int from, int to, off_t start, off_t end) {
    static char buffer[1 << 16];
    while (start < end) {
        size_t most = end - start < (off_t)sizeof buffer ? (size_t)(end - start) : sizeof buffer;
        ssize_t got = syscall(SYS_pread64, from, buffer, most, start);
        /* It may have been cut meanwhile. */
        if (got == 0) return;
        if (got < 0 || syscall(SYS_pwrite64, to, buffer, got, start) != got) {
            trouble("cannot copy to the shadow", strerror(errno));
            return;
        }
        start += got;
    }
}

/* A call that makes, writes or syncs something is about to take place. */
static void about_to_change(void) {
    if (++calls == cut) {
        kill(getpid(), SIGKILL);
        pause();
    }
}

/* A descriptor of the same file that can be read. */
static int readable(int fd) {
    char path[64];
    snprintf(path, sizeof path, "/proc/self/fd/%d", fd);
    int from = syscall(SYS_openat, AT_FDCWD, path, O_RDONLY | O_CLOEXEC, 0);
    if (from < 0) trouble("cannot read again", path);
    return from;
}

static void sync_file(struct object *object, int fd) {
    struct stat stat;
    int from = readable(fd), to = shadow_file(object->number, "", O_WRONLY);
    if (from >= 0 && to >= 0 && fstat(from, &stat) == 0 && syscall(SYS_ftruncate, to, stat.st_size) == 0) {
        for (size_t i = 0; i < object->ranges; i++) {
            struct range range = object->dirty[i];
            copy(from, to, range.start, range.end < stat.st_size ? range.end : stat.st_size);
        }
    }
    object->ranges = 0;
    close(from);
    close(to);
}

static void sync_directory(const struct object *object, int fd) {
    char path[PATH_BYTES], new[PATH_BYTES];
    int again = syscall(SYS_openat, fd, ".", O_RDONLY | O_DIRECTORY | O_CLOEXEC, 0);
    DIR *names = again < 0 ? NULL : fdopendir(again);
    int to = shadow_file(object->number, ".new", O_WRONLY | O_TRUNC);
    FILE *listing = to < 0 ? NULL : fdopen(to, "w");
    if (names == NULL || listing == NULL) {
        trouble("cannot list", object->path);
        return;
    }
    for (struct dirent *entry; (entry = readdir(names)) != NULL;) {
        struct stat stat;
        if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0) continue;
        /* It may have been removed meanwhile. */
        if (fstatat(again, entry->d_name, &stat, AT_SYMLINK_NOFOLLOW) != 0) continue;
        struct object *named = find(&stat);
        if (named == NULL) trouble("made by a call that is not caught", entry->d_name);
        else fprintf(listing, "%c %u %s\n", named->directory ? 'd' : 'f', named->number, entry->d_name);
    }
    closedir(names);
    fclose(listing);
    snprintf(new, sizeof new, "%s/%u.new", shadow, object->number);
    snprintf(path, sizeof path, "%s/%u", shadow, object->number);
    if (syscall(SYS_renameat2, AT_FDCWD, new, AT_FDCWD, path, 0) != 0) trouble("cannot rename", new);
}

static void sync_object(struct object *object, int fd) {
    if (object->directory) sync_directory(object, fd);
    else sync_file(object, fd);
}

/* What a disk may do unasked: some sectors of what was written reach it, or the names of some directory. */
static void write_back(struct object *object, int fd) {
    if (seed == 0) return;
    if (object->ranges > 0 && draw(8) == 0) {
        struct range range = object->dirty[draw(object->ranges)];
        off_t start = range.start + (off_t)draw(range.end - range.start + 1) / SECTOR * SECTOR;
        off_t end = start + (off_t)(1 + draw(64)) * SECTOR;
        int from = readable(fd), to = shadow_file(object->number, "", O_WRONLY);
        if (from >= 0 && to >= 0) copy(from, to, start, end < range.end ? end : range.end);
        close(from);
        close(to);
    }
    if (draw(64) == 0) {
        struct object *directory = &objects[draw(count)];
        struct stat stat;
        if (!directory->directory) return;
        int names = syscall(SYS_openat, AT_FDCWD, directory->path, O_RDONLY | O_DIRECTORY | O_CLOEXEC, 0);
        /* It may have gone, and another have come to its place. */
        if (names >= 0 && fstat(names, &stat) == 0 && find(&stat) == directory) sync_directory(directory, names);
        close(names);
    }
}

/* The object behind a descriptor, under the lock; NULL, and no lock, if it is none of ours. */
static struct object *lock(int fd) {
    struct stat stat;
    if (root == NULL || fstat(fd, &stat) != 0 || !(S_ISREG(stat.st_mode) || S_ISDIR(stat.st_mode))) return NULL;
    pthread_mutex_lock(&mutex);
    struct object *object = find(&stat);
    if (object == NULL) pthread_mutex_unlock(&mutex);
    return object;
}

/* Everything under a directory is synced; at the start it becomes known before. */
static void sync_all(const char *path, bool start) {
    struct stat stat;
    int fd = syscall(SYS_openat, AT_FDCWD, path, O_RDONLY | O_NOFOLLOW | O_CLOEXEC, 0);
    if (fd < 0 || fstat(fd, &stat) != 0) {
        trouble("cannot read", path);
        return;
    }
    struct object *object = start ? made(&stat, path) : find(&stat);
    if (object == NULL) {
        trouble("made by a call that is not caught", path);
        close(fd);
        return;
    }
    if (object->directory) {
        DIR *names = opendir(path);
        for (struct dirent *entry; names != NULL && (entry = readdir(names)) != NULL;) {
            char name[PATH_BYTES];
            if (strcmp(entry->d_name, ".") == 0 || strcmp(entry->d_name, "..") == 0) continue;
            snprintf(name, sizeof name, "%s/%s", path, entry->d_name);
            sync_all(name, start);
        }
        if (names != NULL) closedir(names);
    } else if (start) {
        /* A journal is mostly a hole. */
        off_t from = 0, to;
        while ((from = lseek64(fd, from, SEEK_DATA)) >= 0 && (to = lseek64(fd, from, SEEK_HOLE)) >= 0) {
            wrote(object, from, to);
            from = to;
        }
    }
    /* The table may have moved. */
    sync_object(find(&stat), fd);
    close(fd);
}

__attribute__((constructor)) static void start(void) {
    const char *disk = getenv("POWER_DISK"), *unasked = getenv("POWER_SEED"), *pipe = getenv("POWER_LOOKED");
    shadow = getenv("POWER_SHADOW");
    if (disk == NULL || shadow == NULL) return;
    if (getenv("POWER_CUT") != NULL) cut = strtoull(getenv("POWER_CUT"), NULL, 10);
    if (getenv("POWER_FAILS") != NULL) failing = strtoull(getenv("POWER_FAILS"), NULL, 10);
    if (pipe != NULL) {
        /* It is there already if the program was started before. */
        mkfifo(pipe, 0600);
        looked = syscall(SYS_openat, AT_FDCWD, pipe, O_RDONLY | O_NONBLOCK | O_CLOEXEC, 0);
        if (looked < 0) trouble("cannot open the pipe", pipe);
    }
    /* Never 0, which would draw 0 for ever. */
    if (unasked != NULL) seed = strtoull(unasked, NULL, 10) * 2 + 1;
    pthread_mutex_lock(&mutex);
    sync_all(disk, true);
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

/* A descriptor is about to be written or synced. */
static void about_to_change_file(int fd) {
    if (lock(fd) == NULL) return;
    about_to_change();
    pthread_mutex_unlock(&mutex);
}

/* So many bytes were written up to an offset; below 0 it is where the descriptor stands. */
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
    /* What is cut off and written anew later is zeros in between. */
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

/* Waits for so many looks that of two readers one has begun meanwhile and is done. If there is none it does not wait: one
 * that looks no more closes the pipe. */
static void wait_for_looks(void) {
    char told[256];
    ssize_t got;
    do got = syscall(SYS_read, looked, told, sizeof told);
    while (got > 0);
    if (got == 0) return;
    struct pollfd look = {.fd = looked, .events = POLLIN};
    for (ssize_t looks = 0; looks < LOOKS; looks += got) {
        if (poll(&look, 1, MOST_MS) == 0) trouble("nobody looks", "while a journal is synced");
        got = syscall(SYS_read, looked, told, sizeof told);
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
    bool fails = journal && ++journal_syncs == failing;
    if (fails) object->ranges = 0;
    else sync_object(object, fd);
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
