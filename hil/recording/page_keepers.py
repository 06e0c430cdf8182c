"""What shows a run in Rerun: its page in a file, and the live view."""

import os
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from servobench.hil.recording.log_files import BLOCK_ROWS, LIVE_VIEW, Keeper, RowBlocks
from servobench.hil.recording.serving import comes_to_listen, free_port, serve_stream
from servobench.hil.recording.telemetry import Telemetry
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import LOOPBACK, RecordingPlan, ServedPorts
from servobench.hil.rows.records import Rows
from servobench.hil.rows.run_files import RERUN_FILE
from servobench.hil.rows.side_rows import RunEvent
from servobench.hil.verdict.summary import Summary
from servobench.virtual_bus.child_python import python_command, python_environment

_LIVE_MEMORY = "256MiB"


class PageKeeper(Keeper):
    """Keeper that shows the run in Rerun."""

    def __init__(self, telemetry: Telemetry, review: Review, block_rows: int = BLOCK_ROWS) -> None:
        self._telemetry = telemetry
        self._review = review
        self._blocks = RowBlocks(block_rows)

    def take(self, rows: Rows, frames: NDArray[np.void], events: Sequence[RunEvent]) -> None:
        self._telemetry.take_events(events)
        self._telemetry.observed.take(frames)
        if self._blocks.add(rows):
            self._send_block()

    def flush(self) -> None:
        self._send_block()
        self._telemetry.flush()

    def finish(self, summary: Summary) -> None:
        self._send_block()
        self._telemetry.finish(summary, self._review)

    def _send_block(self) -> None:
        block = self._blocks.take()
        if block is not None:
            self._telemetry.take_rows(block)


class RerunKeeper(PageKeeper):
    """run.rrd; in a stream of its own, so that no viewer can hold it up."""

    name = RERUN_FILE

    def __init__(self, plan: RecordingPlan, folder: Path, recording_id: str, review: Review) -> None:
        self._path = folder / RERUN_FILE
        super().__init__(Telemetry(plan, recording_id, rr.FileSink(self._path)), review)
        self._shows_at_end = plan.view and not plan.real_time

    def finish(self, summary: Summary) -> None:
        super().finish(summary)
        if self._shows_at_end:
            start_viewer(str(self._path))

    def abandon(self) -> None:
        """Turn what is still written away from the disk.

        The thread of Rerun's that writes has some hundred kilobytes in hand when a write fails, and would put
        them where there is room again: into what is kept for the ends of the other files.
        """
        with open(os.devnull, "wb") as nowhere:
            for descriptor in os.listdir("/proc/self/fd"):
                with suppress(OSError):  # that of the listing itself, or closed meanwhile
                    if os.path.samefile(f"/proc/self/fd/{descriptor}", self._path):
                        os.dup2(nowhere.fileno(), int(descriptor), inheritable=False)


class LiveKeeper(PageKeeper):
    """Viewers of a real-time run while it goes on: one of its own, or any that come; on the loopback only."""

    name = LIVE_VIEW

    def __init__(self, plan: RecordingPlan, recording_id: str, review: Review) -> None:
        """Error: OSError if a port is taken."""
        port = free_port() if plan.served is None else plan.served.stream
        sink = rr.GrpcServerSink(bind_ip=LOOPBACK, port=port, server_memory_limit=_LIVE_MEMORY)
        super().__init__(Telemetry(plan, recording_id, sink, live=True), review, block_rows=1)
        super().flush()  # a port that is taken shows only here
        self._page = None if plan.served is None else _page_on(plan.served)
        if plan.view:
            start_viewer("--connect", sink.uri)

    def flush(self) -> None:
        self._telemetry.show_running(self._review)
        super().flush()

    def finish(self, summary: Summary) -> None:
        super().finish(summary)
        if self._page is not None:
            self._page.kill()
            self._page.wait()


def _page_on(ports: ServedPorts) -> "subprocess.Popen[bytes]":
    """The page for browsers. Error: OSError if it does not come up."""
    page = serve_stream(ports)
    if not comes_to_listen(page, ports.page):
        page.kill()
        raise OSError(f"no page for browsers comes up at port {ports.page}")
    return page


def open_pages(plan: RecordingPlan, folder: Path, review: Review) -> list[Keeper]:
    """The page in ``folder``, and beside it the live view if the plan asks for one."""
    rr.set_strict_mode(True)
    recording_id = uuid4().hex
    pages: list[Keeper] = [RerunKeeper(plan, folder, recording_id, review)]
    if plan.real_time and (plan.view or plan.served is not None):
        pages.append(LiveKeeper(plan, recording_id, review))
    return pages


def start_viewer(*arguments: str) -> None:
    """Start the viewer as a process that outlives this one."""
    subprocess.Popen(
        python_command("rerun_cli", "--port", "auto", "--bind", LOOPBACK, *arguments),
        env=python_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
