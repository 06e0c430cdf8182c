"""The process that a test starts in the place of ``hil`` or ``python``: it has another one do the work.

The text of this file becomes the programs of :func:`tests.warm.start.folder`. It imports only what is built
into the interpreter, so that a start costs some milliseconds. What the server does not take (an environment
that is not its own, ``--view``, another program) is executed as it is, in this process's place.
"""

import _signal  # type: ignore[import-not-found]
import _socket
import marshal
import posix
import sys

LOGGER = ("servobench.hil.recording.logger", "servobench.hil.recording.recovery")
"""Programs that need Rerun: it starts threads when it is imported, so they have a server of their own."""
OURS = (
    *LOGGER,
    "servobench.hil.campaign.worker",
    "servobench.hil.cli",
    "tests.warm.report",
    "servobench.virtual_bus.bus.hub_process",
)
"""Programs that are forked; any other is executed."""
FORWARDED = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2")


def main(real: str) -> None:
    """Have ``sys.argv`` done; leaves with its status, or by its signal."""
    place, name = sys.argv[0].rsplit("/", 1)
    arguments = sys.argv[1:]
    descriptors = [int(each) for each in posix.listdir("/proc/self/fd")]
    inherited = [each for each in descriptors if _is_inherited(each)]
    signals = [getattr(_signal, each) for each in FORWARDED]
    ignored = [int(each) for each in signals if _signal.getsignal(each) == _signal.SIG_IGN]
    if name == "hil":
        module, words = "servobench.hil.cli", arguments
    elif arguments[:2] == ["-P", "-m"]:
        module, words = arguments[2], arguments[3:]
    else:
        module, words = "", arguments
    server = _socket.socket(_socket.AF_UNIX, _socket.SOCK_STREAM)
    taken = b""
    if module in OURS:
        server.connect(f"{place}/{'logger' if module in LOGGER else 'bench'}")
        what = marshal.dumps((module, words, posix.getcwd(), dict(posix.environ), inherited, ignored))
        rights = b"".join(each.to_bytes(4, sys.byteorder) for each in inherited)
        server.sendmsg([len(what).to_bytes(4, "little")], [(_socket.SOL_SOCKET, _socket.SCM_RIGHTS, rights)])
        server.sendall(what)
        taken = server.recv(1)
    if not taken:
        posix.execv(real, [real, *arguments])
    for number in {*signals} - {*ignored}:
        _signal.signal(number, lambda heard, _: server.sendall(bytes([heard])))
    status = int.from_bytes(server.recv(4), "little", signed=True)
    if status < 0:
        if -status in signals:
            _signal.signal(-status, _signal.SIG_DFL)
        posix.kill(posix.getpid(), -status)
    posix._exit(status)


def _is_inherited(descriptor: int) -> bool:
    try:
        return posix.get_inheritable(descriptor)
    except OSError:  # that of the list itself
        return False
