/*
 * A machine that was suspended, for one program: loaded into it (LD_PRELOAD), its monotonic clock lags by the
 * nanoseconds at the beginning of the file ASLEEP, as a suspended machine's does. Boot time and wall clock,
 * by which the kernel stamps frames, go on.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { SECOND = 1000000000 };

static const volatile int64_t *asleep;

__attribute__((constructor)) static void open_file(void)
{
    const char *path = getenv("ASLEEP");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;

    if (file < 0)
        _exit(125);
    asleep = mmap(NULL, sizeof *asleep, PROT_READ, MAP_SHARED, file, 0);
    close(file);
}

static int lags(clockid_t which)
{
    return asleep && (which == CLOCK_MONOTONIC || which == CLOCK_MONOTONIC_RAW || which == CLOCK_MONOTONIC_COARSE);
}

static void add(struct timespec *at, int64_t ns)
{
    int64_t sum = at->tv_sec * (int64_t)SECOND + at->tv_nsec + ns;

    at->tv_sec = sum / SECOND;
    at->tv_nsec = sum % SECOND;
}

int clock_gettime(clockid_t which, struct timespec *now)
{
    int status = syscall(SYS_clock_gettime, which, now);

    if (!status && lags(which))
        add(now, -*asleep);
    return status;
}

int clock_nanosleep(clockid_t which, int flags, const struct timespec *until, struct timespec *left)
{
    struct timespec at = *until;

    if (lags(which) && flags & TIMER_ABSTIME)
        add(&at, *asleep);
    return syscall(SYS_clock_nanosleep, which, flags, &at, left) ? errno : 0;
}
