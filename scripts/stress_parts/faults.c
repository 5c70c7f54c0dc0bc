/* Fails the k-th write-like call of a program, wherever in it that is made: Python, GDAL, Pillow.
 *
 * Preloaded before libc. Nothing fails until `faults_arm` is called; then every call below that
 * changes something under PREFIX is counted, over all threads and forked children, and the k-th
 * fails with an errno, or is where a signal comes. Calls that take something away (unlink, rmdir)
 * never fail: a full disk lets them.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { ONCE, FROM_THEN_ON, SIGNAL };

static struct {
    atomic_long count;
    long at; /* 0: nothing fails, calls are counted */
    int armed, mode, code;
    size_t length;
    char prefix[4096], what[128];
} *shared;

static char tracked[65536]; /* descriptors open for writing under PREFIX */

__attribute__((constructor)) static void begin(void) {
    shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}

void faults_arm(const char *prefix, long at, int mode, int code) {
    strncpy(shared->prefix, prefix, sizeof shared->prefix - 1);
    shared->length = strlen(shared->prefix);
    shared->at = at, shared->mode = mode, shared->code = code;
    shared->what[0] = 0;
    atomic_store(&shared->count, 0);
    memset(tracked, 0, sizeof tracked);
    shared->armed = 1;
}

void faults_disarm(void) { shared->armed = 0; }
long faults_count(void) { return atomic_load(&shared->count); }
const char *faults_what(void) { return shared->what; }

static int under(const char *path) {
    return shared && shared->armed && path && !strncmp(path, shared->prefix, shared->length);
}

static int ours(int fd) {
    return shared && shared->armed && fd >= 0 && fd < (int)sizeof tracked && tracked[fd];
}

/* Whether this call is the one that fails; errno is set then. */
static int hit(const char *what, int lasting) {
    long now = atomic_fetch_add(&shared->count, 1) + 1;
    if (!shared->at || now < shared->at) return 0;
    if (now > shared->at && (shared->mode != FROM_THEN_ON || !lasting)) return 0;
    if (now == shared->at) snprintf(shared->what, sizeof shared->what, "%s", what);
    if (shared->mode == SIGNAL) {
        kill(getpid(), shared->code);
        return 0;
    }
    errno = shared->code;
    return 1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define WRITES(flags) ((flags) & (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC))

static int opened(int fd, int flags, int is_under) {
    if (fd >= 0 && fd < (int)sizeof tracked) tracked[fd] = is_under && WRITES(flags);
    return fd;
}

#define OPEN(name)                                                                 \
    int name(const char *path, int flags, ...) {                                   \
        va_list rest;                                                              \
        va_start(rest, flags);                                                     \
        mode_t mode = va_arg(rest, mode_t);                                        \
        va_end(rest);                                                              \
        int is_under = under(path);                                                \
        if (is_under && WRITES(flags) && hit("open", 1)) return -1;                \
        return opened(REAL(name)(path, flags, mode), flags, is_under);             \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                               \
    int name(int folder, const char *path, int flags, ...) {                       \
        va_list rest;                                                              \
        va_start(rest, flags);                                                     \
        mode_t mode = va_arg(rest, mode_t);                                        \
        va_end(rest);                                                              \
        int is_under = under(path);                                                \
        if (is_under && WRITES(flags) && hit("openat", 1)) return -1;              \
        return opened(REAL(name)(folder, path, flags, mode), flags, is_under);     \
    }
OPENAT(openat)
OPENAT(openat64)

#define FOPEN(name)                                                                \
    FILE *name(const char *path, const char *mode) {                               \
        int writes = strpbrk(mode, "wa+") != NULL, is_under = under(path);         \
        if (is_under && writes && hit("fopen", 1)) return NULL;                    \
        FILE *file = REAL(name)(path, mode);                                       \
        if (file) opened(fileno(file), writes ? O_WRONLY : 0, is_under);           \
        return file;                                                               \
    }
FOPEN(fopen)
FOPEN(fopen64)

int dup(int fd) {
    int copy = REAL(dup)(fd);
    if (copy >= 0 && copy < (int)sizeof tracked) tracked[copy] = ours(fd);
    return copy;
}

int close(int fd) {
    int failed = ours(fd) && hit("close", 0), code = errno;
    if (fd >= 0 && fd < (int)sizeof tracked) tracked[fd] = 0;
    int done = REAL(close)(fd);
    if (!failed) return done;
    errno = code;
    return -1;
}

int fclose(FILE *file) {
    int fd = fileno(file), failed = ours(fd) && hit("fclose", 1), code = errno;
    if (fd >= 0 && fd < (int)sizeof tracked) tracked[fd] = 0;
    int done = REAL(fclose)(file);
    if (!failed) return done;
    errno = code;
    return EOF;
}

size_t fwrite(const void *data, size_t size, size_t count, FILE *file) {
    if (ours(fileno(file)) && hit("fwrite", 1)) return 0;
    return REAL(fwrite)(data, size, count, file);
}

int fflush(FILE *file) {
    if (file && ours(fileno(file)) && hit("fflush", 1)) return EOF;
    return REAL(fflush)(file);
}

#define ON_FD(type, name, signature, call)                                         \
    type name signature {                                                          \
        if (ours(fd) && hit(#name, 1)) return -1;                                  \
        return REAL(name) call;                                                    \
    }
ON_FD(ssize_t, write, (int fd, const void *data, size_t size), (fd, data, size))
ON_FD(ssize_t, writev, (int fd, const struct iovec *data, int count), (fd, data, count))
ON_FD(ssize_t, pwrite, (int fd, const void *data, size_t size, off_t at), (fd, data, size, at))
ON_FD(ssize_t, pwrite64, (int fd, const void *data, size_t size, off64_t at), (fd, data, size, at))
ON_FD(int, ftruncate, (int fd, off_t size), (fd, size))
ON_FD(int, ftruncate64, (int fd, off64_t size), (fd, size))
ON_FD(int, fsync, (int fd), (fd))
ON_FD(int, fdatasync, (int fd), (fd))
ON_FD(int, fchmod, (int fd, mode_t mode), (fd, mode))
ON_FD(ssize_t, sendfile, (int fd, int in, off_t *at, size_t size), (fd, in, at, size))
ON_FD(ssize_t, sendfile64, (int fd, int in, off64_t *at, size_t size), (fd, in, at, size))

ssize_t copy_file_range(int in, off64_t *in_at, int fd, off64_t *at, size_t size, unsigned flags) {
    if (ours(fd) && hit("copy_file_range", 1)) return -1;
    return REAL(copy_file_range)(in, in_at, fd, at, size, flags);
}

#define ON_PATH(name, signature, call)                                             \
    int name signature {                                                           \
        if (under(path) && hit(#name, 0)) return -1;                               \
        return REAL(name) call;                                                    \
    }
ON_PATH(rename, (const char *from, const char *path), (from, path))
ON_PATH(renameat, (int a, const char *from, int b, const char *path), (a, from, b, path))
ON_PATH(renameat2, (int a, const char *from, int b, const char *path, unsigned flags),
        (a, from, b, path, flags))
ON_PATH(link, (const char *from, const char *path), (from, path))
ON_PATH(symlink, (const char *to, const char *path), (to, path))
ON_PATH(truncate, (const char *path, off_t size), (path, size))
ON_PATH(truncate64, (const char *path, off64_t size), (path, size))
ON_PATH(chmod, (const char *path, mode_t mode), (path, mode))
ON_PATH(utimensat, (int folder, const char *path, const struct timespec times[2], int flags),
        (folder, path, times, flags))

int mkdir(const char *path, mode_t mode) {
    if (under(path) && hit("mkdir", 1)) return -1;
    return REAL(mkdir)(path, mode);
}
