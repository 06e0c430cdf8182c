"""``python -P -m tests.warm.report STATUS``: prints what a process finds when it starts, to compare."""

import fcntl
import json
import os
import signal
import sys


def main() -> None:
    """One line of JSON; then it leaves as it is asked: by a status, or -N by signal N."""
    found = {
        "arguments": sys.argv[1:],
        "parent": os.getppid(),
        "folder": os.getcwd(),
        "environment": dict(os.environ),
        "input": sys.stdin.read(),
        "streams": [(each.encoding, each.errors, each.line_buffering) for each in (sys.stdout, sys.stderr)],
        "descriptors": [int(each) for each in os.listdir("/proc/self/fd") if _is_open(int(each))],
        "threads": len(os.listdir("/proc/self/task")),
        "blocked": sorted(map(int, signal.pthread_sigmask(signal.SIG_BLOCK, []))),
        "handlers": {str(number): str(signal.getsignal(number)) for number in signal.valid_signals()},
    }
    print(json.dumps(found))
    print("on stderr", file=sys.stderr)
    status = int(sys.argv[1])
    if status < 0:
        sys.stdout.flush()
        os.kill(os.getpid(), -status)
        signal.pause()
    sys.exit(status)


def _is_open(descriptor: int) -> bool:
    try:
        return not fcntl.fcntl(descriptor, fcntl.F_GETFD) & fcntl.FD_CLOEXEC
    except OSError:
        return False


if __name__ == "__main__":
    main()
