"""Render the recording of a run as a picture: ``python docs/make_pictures.py RUN_FOLDER [PICTURE]``.

The native Rerun viewer draws without a window; it needs a Vulkan driver, for which a
software one will do (Debian: mesa-vulkan-drivers). The page is one that a user sees on
opening ``run.rrd``, with the cursor at the end of the run.
"""

import argparse
import socket
import subprocess
import sys
from pathlib import Path

from rerun.experimental import ViewerClient

from drivers.errors import PeerFault
from drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from hil.recording.blueprint import TIMELINE

_SIZE = "1920x1080"
_START_MAX_NS = 30 * NS_PER_S
_SETTLE_TRIES = 40
_GREETING_NS = 5 * NS_PER_S
"""For so long the viewer shows a notice over the page."""
_POLL_NS = 200 * NS_PER_MS


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("run", type=Path, help="folder of a run, or its run.rrd")
    parser.add_argument("picture", type=Path, nargs="?", default=Path(__file__).parent / "run-review.png")
    parser.add_argument("--at", type=float, default=None, help="cursor, s; the end of the run if left out")
    arguments = parser.parse_args()
    recording = arguments.run / "run.rrd" if arguments.run.is_dir() else arguments.run
    arguments.picture.write_bytes(render(recording.resolve(), arguments.at))
    print(arguments.picture)


def render(recording: Path, at_s: float | None = None) -> bytes:
    """The viewer's whole window as PNG. Error: PeerFault if it does not come up, or a view complains."""
    port = _free_port()
    command = [sys.executable, "-m", "rerun_cli", "--headless", "--bind", "127.0.0.1", "--port", str(port)]
    command += ["--window-size", _SIZE, "--hide-welcome-screen"]
    viewer = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        return _picture(_connect(viewer, port), recording, at_s)
    finally:
        # The command is a shim; its child, the viewer, ends with the session's leader's group.
        subprocess.run(["kill", "--", f"-{viewer.pid}"], check=False)
        viewer.communicate()


def _connect(viewer: subprocess.Popen[bytes], port: int) -> ViewerClient:
    clock = MonotonicClock()
    deadline = clock.now() + _START_MAX_NS
    while clock.now() < deadline and viewer.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        clock.sleep_until(Instant(clock.now() + _POLL_NS))
    viewer.kill()
    evidence = (viewer.communicate()[1] or b"").decode(errors="replace").strip().splitlines()[-1:]
    raise PeerFault(
        "the viewer does not come up",
        "".join(evidence),
        "install a Vulkan driver: apt install mesa-vulkan-drivers",
    )


def _picture(client: ViewerClient, recording: Path, at_s: float | None) -> bytes:
    client.open(str(recording))
    clock = MonotonicClock()
    while client.get_state().loading:
        clock.sleep_until(Instant(clock.now() + _POLL_NS))
    _check_views(client)
    client.set_time(TIMELINE, duration=_end_s(client) if at_s is None else at_s, play_state="paused")
    clock.sleep_until(Instant(clock.now() + _GREETING_NS))
    last = b""
    for _ in range(_SETTLE_TRIES):
        clock.sleep_until(Instant(clock.now() + _POLL_NS))
        found = client.take_screenshot()
        if found == last:
            break
        last = found
    return last


def _check_views(client: ViewerClient) -> None:
    for view in client.get_state().views:
        for report in view.reports:
            raise PeerFault(f"the view {view.name!r} reports: {report.summary}", report.details or "")


def _end_s(client: ViewerClient) -> float:
    ends = [
        timeline.end
        for recording in client.get_state().recordings
        for timeline in recording.timelines
        if timeline.name == TIMELINE and timeline.end is not None
    ]
    return max(ends, default=0) / NS_PER_S


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


if __name__ == "__main__":
    main()
