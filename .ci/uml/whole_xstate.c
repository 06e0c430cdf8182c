/*
 * Lets an older User Mode Linux run on a processor with a large extended state (AMX).
 *
 * That kernel keeps 2696 bytes of a process's extended registers, all there was up to
 * AVX-512. The outer kernel gives a truncated copy readily, but takes back the whole state
 * only (11008 bytes with AMX) and answers EFAULT to less, so the boot ends in a panic. Loaded
 * into linux.uml (LD_PRELOAD), this completes the write: the present whole state is read, its
 * beginning replaced, the whole written. What lies beyond the 2696 bytes stays as it was in
 * that process; nothing in there uses it, because its use must be asked for first.
 */
#define _GNU_SOURCE
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { WHOLE_MAX = 65536 };

static long plain(long request, long pid, void *addr, void *data)
{
    return syscall(SYS_ptrace, request, pid, addr, data);
}

/* Writes the beginning of process pid's state and keeps the rest. */
static long set_whole(long pid, void *addr, const struct iovec *part)
{
    static _Thread_local unsigned char state[WHOLE_MAX] __attribute__((aligned(64)));
    struct iovec whole = {.iov_base = state, .iov_len = sizeof state};

    if (plain(PTRACE_GETREGSET, pid, addr, &whole) < 0)
        return -1;
    memcpy(state, part->iov_base, part->iov_len < whole.iov_len ? part->iov_len : whole.iov_len);
    return plain(PTRACE_SETREGSET, pid, addr, &whole);
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list rest;
    va_start(rest, request);
    pid_t pid = va_arg(rest, pid_t);
    void *addr = va_arg(rest, void *);
    void *data = va_arg(rest, void *);
    va_end(rest);

    if (request == PTRACE_PEEKTEXT || request == PTRACE_PEEKDATA || request == PTRACE_PEEKUSER) {
        /* These return what they read, as the C library's do. */
        long word = 0;
        long status = plain(request, pid, addr, &word);
        if (status < 0)
            return status;
        errno = 0;
        return word;
    }
    long status = plain(request, pid, addr, data);
    if (status < 0 && errno == EFAULT && request == PTRACE_SETREGSET && (long)addr == NT_X86_XSTATE)
        return set_whole(pid, addr, data);
    return status;
}
