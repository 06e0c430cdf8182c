"""Environments that are not the usual one: what a shell does before it becomes the command.

A command ends in each with one of its statuses; where it passes, with the rows of any other place.
"""

from dataclasses import dataclass
from typing import Final

PASSED, BAD_INPUT, NOT_RECORDED, CUT_SHORT = 0, 2, 5, 6
STARVED: Final = (PASSED, NOT_RECORDED, CUT_SHORT)
"""It depends on how much there is, and who gets it."""


@dataclass(frozen=True, slots=True)
class Environment:
    """``script``: for bash, with the command in "$@", an empty folder in $PLACE and a number in $SEED."""

    script: str
    statuses: tuple[int, ...] = (PASSED,)
    records: bool = True
    """The command keeps a recording, in $PLACE."""


def _only_run(script: str) -> Environment:
    return Environment(script, records=False)


def _limited(limit: str, *statuses: int) -> Environment:
    return Environment(f'ulimit {limit}; exec "$@"', statuses or (PASSED,))


def _mounted(script: str, *statuses: int) -> Environment:
    whole = f'set -e; mount --make-rprivate /; {script}; exec "$@"'
    return Environment(f"exec unshare -rm bash -c '{whole}' bash \"$@\"", statuses or (PASSED,))


def _disk(size: str, *statuses: int) -> Environment:
    return _mounted(f"mount -t tmpfs -o {size} none $PLACE", *statuses)


def _grouped(kind: str, file: str, value: str, *statuses: int) -> Environment:
    """In a control group (version 1) of its own, which is taken away afterwards."""
    script = (
        f"set -e; group=/sys/fs/cgroup/{kind}/servobench-$$; mkdir $group; echo {value} > $group/{file};"
        " status=0;"
        ' (echo $BASHPID > $group/cgroup.procs; exec "$@") || status=$?;'
        " for again in $(seq 50); do rmdir $group 2>/dev/null && break; sleep 0.1; done; exit $status"
    )
    return Environment(script, statuses or (PASSED,))


def _as_user(number: int, before: str = "", *statuses: int) -> Environment:
    user = f'exec setpriv --reuid {number} --regid {number} --clear-groups "$@"'
    return Environment(before + user, statuses or (PASSED,), records=False)


_BACK: Final = (
    "#include <sys/syscall.h>\n#include <time.h>\n#include <unistd.h>\nstatic time_t back;\n"
    "int clock_gettime(clockid_t which, struct timespec *now)"
    " { int status = syscall(SYS_clock_gettime, which, now);"
    " if (which == CLOCK_REALTIME) now->tv_sec -= back++ * 60; return status; }\n"
)
"""Sets the wall clock back by another minute each time that it is asked for."""
_SUSPENDED: Final = (
    'set -m; "$@" & all=-$!; for again in $(seq $((4 + SEED % 8))); do kill -STOP -- $all || break;'
    " sleep 0.2; kill -CONT -- $all; sleep 0.3; done 2>/dev/null; wait $!"
)
"""The whole group of processes, as Ctrl-Z and fg, or a machine that sleeps, do it."""
_FOLDER: Final = "$PLACE/$'\\xff\\n a'"

ENVIRONMENTS: Final = {
    "no HOME": _only_run('unset HOME; exec "$@"'),
    "HOME is nowhere": _only_run('HOME=/nowhere exec "$@"'),
    "HOME is read-only": _mounted("mkdir $PLACE/h; mount -t tmpfs -o ro none $PLACE/h; export HOME=$PLACE/h"),
    "TMPDIR is nowhere": _only_run('TMPDIR=/nowhere exec "$@"'),
    "nothing in the environment": _only_run('exec env -i PYTHONPATH="$PYTHONPATH" "$@"'),
    "ASCII": _only_run('LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 exec "$@"'),
    "an odd locale": _only_run('LC_ALL=tr_TR.ISO-8859-9 exec "$@"'),
    "an odd time zone": Environment('TZ=Antarctica/Troll exec "$@"'),
    "no PATH": _only_run('PATH= exec "$@"'),
    "no asserts, no docstrings": _only_run('PYTHONOPTIMIZE=2 exec "$@"'),
    "no asserts": Environment('PYTHONOPTIMIZE=1 exec "$@"'),
    "hashes as they are": Environment('PYTHONHASHSEED=0 exec "$@"'),
    "a wall clock that is set back": Environment(
        f"printf %s '{_BACK}' | cc -shared -fPIC -xc -o $PLACE/back.so - || exit; LD_PRELOAD=$PLACE/back.so "
        'exec "$@"'
    ),
    "no core, whatever crashes": _limited("-c 0"),
    "umask 777": Environment('umask 777; exec "$@"', (PASSED, BAD_INPUT, NOT_RECORDED)),
    "the current folder is gone": Environment(
        'mkdir $PLACE/gone; cd $PLACE/gone; rmdir $PLACE/gone; exec "$@"', (BAD_INPUT,)
    ),
    "a folder whose name is no text": Environment(f'mkdir {_FOLDER}; cd {_FOLDER}; exec "$@"'),
    "6000 characters of folders": Environment(
        'cd $PLACE; for n in $(seq 60); do f=$(printf %0100d $n); mkdir $f; cd $f; done; exec "$@"'
    ),
    "40 files": _limited("-n 40"),
    "8 files": _limited("-n 8", CUT_SHORT),
    "some files": _limited("-n $((8 + SEED % 32))", *STARVED),
    "300 MB of addresses": _limited("-v 300000", BAD_INPUT),
    "some addresses": _limited("-v $((450000 + SEED * 7919 % 2000000))", *STARVED),
    "a small stack": _limited("-s 256"),
    "a stack without end": _limited("-s unlimited"),
    "no locked memory": _limited("-l 0"),
    "no pending signals": _limited("-i 0"),
    "a second of processor time": _limited("-t 1", *STARVED),
    "files of 64 kB": _limited("-f 64", NOT_RECORDED),
    "not root, without a place to write to": _as_user(65534, "HOME=/nowhere "),
    "not root, one process": _as_user(65534, "ulimit -u 1; ", CUT_SHORT),
    "a user without a name": _as_user(54321),
    "no /dev/shm": _mounted("mount -t tmpfs -o ro none /dev/shm"),
    "no /proc": _mounted("mount -t tmpfs -o ro none /proc"),
    "no /sys": _mounted("mount -t tmpfs -o ro none /sys"),
    "a disk of 4 kB": _disk("size=4k", BAD_INPUT, NOT_RECORDED),
    "some disk": _disk("size=$((4 + SEED * 37 % 1020))k", PASSED, BAD_INPUT, NOT_RECORDED),
    "a disk for four files": _disk("nr_inodes=4", BAD_INPUT, NOT_RECORDED),
    "booted long ago": Environment('exec unshare -T --monotonic 100000000 --boottime 100000000 "$@"'),
    "booted just now": Environment('exec unshare -T --monotonic -$(cut -d. -f1 /proc/uptime) "$@"'),
    "some memory for all processes": _grouped(
        "memory", "memory.limit_in_bytes", "$((40 + SEED * 7 % 500))M", *STARVED
    ),
    "some processes at once": _grouped("pids", "pids.max", "$((1 + SEED % 16))", *STARVED),
    "a fifth of a processor": _grouped("cpu", "cpu.cfs_quota_us", "20000"),
    "one processor": Environment('exec taskset -c 0 "$@"'),
    "addresses as they are": Environment('exec setarch -R "$@"'),
    "suspended and resumed": Environment(_SUSPENDED),
    "a session of its own, no stdin": Environment('exec setsid -w "$@" <&-'),
}
