/* The shadow of the disk: what is durable, kept in files of its own.
 *
 * The shadow holds a file for each file and directory that ever existed, named by a number; a missing one is empty. The
 * file under a directory's number is its listing, replaced as a whole, with a line for each name: "f" or "d", a number,
 * the name. The root has the number 0; until its listing exists, the program has not begun. The file "trouble" reports
 * changes that were not caught. */

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

enum { SECTOR = 512, PATH_BYTES = 4096 };

struct range {
    off_t start, end;
};

/* A file or a directory under the root. */
struct object {
    dev_t device;
    ino_t inode;
    unsigned number;
    bool directory;
    /* The path by which a directory was opened last; NULL for a file. */
    char *path;
    /* The ranges of a file that were written since its last sync. */
    struct range *dirty;
    size_t ranges;
};

/* Guards all variables below and the shadow. */
static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static const char *root, *shadow;
static struct object *objects;
static size_t count;
static unsigned numbers;
static uint64_t seed, calls, cut;

/* Reports to the test that the shadow is not exact. */
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

/* Registers a new file or directory. If its inode belonged to another one before, that one's shadow stays under its
 * number, for as long as a listing names it. */
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
        /* The file was truncated meanwhile. */
        if (got == 0) return;
        if (got < 0 || syscall(SYS_pwrite64, to, buffer, got, start) != got) {
            trouble("cannot copy to the shadow", strerror(errno));
            return;
        }
        start += got;
    }
}

/* Counts a call that makes, writes or syncs something, before it takes place. */
static void about_to_change(void) {
    if (++calls == cut) {
        kill(getpid(), SIGKILL);
        pause();
    }
}

/* Opens a readable descriptor of the same file. */
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
        /* The entry was removed meanwhile. */
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

/* Writes some of the dirty sectors, or the names of some directory, as a disk may do at any time. */
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
        /* The path may name another directory by now. */
        if (names >= 0 && fstat(names, &stat) == 0 && find(&stat) == directory) sync_directory(directory, names);
        close(names);
    }
}

/* Locks and returns the object behind a descriptor; returns NULL, without the lock, if it is not watched. */
static struct object *lock(int fd) {
    struct stat stat;
    if (root == NULL || fstat(fd, &stat) != 0 || !(S_ISREG(stat.st_mode) || S_ISDIR(stat.st_mode))) return NULL;
    pthread_mutex_lock(&mutex);
    struct object *object = find(&stat);
    if (object == NULL) pthread_mutex_unlock(&mutex);
    return object;
}

/* Syncs everything under a directory; at the start, registers it first. */
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
        /* A journal is mostly a hole, so only its data is copied. */
        off_t from = 0, to;
        while ((from = lseek64(fd, from, SEEK_DATA)) >= 0 && (to = lseek64(fd, from, SEEK_HOLE)) >= 0) {
            wrote(object, from, to);
            from = to;
        }
    }
    /* The table of objects may have moved. */
    sync_object(find(&stat), fd);
    close(fd);
}
