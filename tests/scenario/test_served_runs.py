"""What is served while a run goes on, and of a recording: by a second reader of Rerun's own, over gRPC."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit
from urllib.request import urlopen

import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.recording.serving import free_port
from tests.rrd_columns import columns, lane, numbers
from tests.scenario.processes import EXAMPLES, HIL, in_background

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")
CLOCK = MonotonicClock()


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: pages are served."""


def start(*arguments: str) -> "subprocess.Popen[str]":
    return in_background([*HIL, *arguments])


def wait_for(condition: Callable[[], bool]) -> None:
    limit = CLOCK.now() + 30 * NS_PER_S
    while not condition():
        assert CLOCK.now() < limit, "it never came"
        wait(50 * NS_PER_MS)


def wait(duration_ns: int) -> None:
    CLOCK.sleep_until(Instant(CLOCK.now() + duration_ns))


def served_by(process: "subprocess.Popen[str]") -> tuple[str, str]:
    """The addresses for a browser and for a viewer, as they are printed."""
    assert process.stderr is not None
    lines = iter(process.stderr.readline, "")
    page = next(line for line in lines if "served to browsers at" in line).split()[-1]
    return page, next(lines).split()[-1]


@contextmanager
def second_reader(uri: str, into: Path) -> Iterator[None]:
    """Rerun's command without a window, that keeps all it is sent."""
    command = [sys.executable, "-m", "rerun_cli", "--headless", "--bind", "127.0.0.1"]
    command += ["--port", str(free_port()), "--connect", uri, "--save", str(into)]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGINT)
        process.wait(10)


def test_a_second_viewer_has_a_run_that_goes_on_and_its_broken_limit(tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    text = (EXAMPLES / "ling2012.toml").read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    text = text.replace('"faults/', f'"{EXAMPLES}/faults/').replace("duration_s = 2.0", "duration_s = 8.0")
    bench.write_text(text.replace("speed_error_peak_percent_max = 6.0", "speed_error_peak_percent_max = 1.0"))
    seen = tmp_path / "seen.rrd"
    run = start("run", str(bench), "--time", "real", "--serve", "--record", str(tmp_path / "run"))
    page, uri = served_by(run)
    port = urlsplit(page).port
    assert urlsplit(page).hostname == urlsplit(uri).hostname == "127.0.0.1"
    assert parse_qs(urlsplit(page).query) == {"url": [uri]}
    with urlopen(f"http://127.0.0.1:{port}/", timeout=5) as answer:
        assert b"Rerun" in answer.read()
    wait_for(lambda: (tmp_path / "run" / "records.tail").exists())
    wait(2 * NS_PER_S)
    attached_at = CLOCK.now()
    with second_reader(uri, seen):
        wait_for(lambda: seen.exists() and seen.stat().st_size > 100_000)
        assert CLOCK.now() - attached_at < 5 * NS_PER_S
        assert run.poll() is None
        assert run.wait(30) == 1
        wait(300 * NS_PER_MS)
    times, _speeds = numbers(seen, "/axis1/speed/measured")
    assert times[0] == 0, "what was before it came is there, too"
    assert times[-1] == 7_999_000_000
    told_at, labels = lane(seen, "limits")
    assert labels in ([["Kept"], ["BROKEN"]], [["BROKEN"]])
    assert told_at[-1] < 3 * NS_PER_S, "the load comes after one second, and each second is judged"
    assert lane(seen, "axis1 link")[1][:2] == [["OK"], ["DEGRADED"]], "2 % are lost"
    told = [text for (text,) in columns(seen, "/events", "TextLog:text")[1]]
    assert any("limit broken: speed error, peak [%]" in str(text) for text in told)
    assert lane(seen, "verdict")[1] == [["Not passed"], ["-"]]
    with pytest.raises(OSError, match="refused"):
        urlopen(f"http://127.0.0.1:{port}/", timeout=5)


def test_a_recording_is_served_until_it_is_ended(tmp_path: Path) -> None:
    folder, seen = tmp_path / "run", tmp_path / "seen.rrd"
    assert start("run", str(EXAMPLES / "ling2012.toml"), "--record", str(folder)).wait(60) == 0
    view = start("view", str(folder), "--serve")
    page, uri = served_by(view)
    with urlopen(page, timeout=5) as answer:
        assert b"Rerun" in answer.read()
    with second_reader(uri, seen):
        wait_for(lambda: seen.exists() and seen.stat().st_size > 100_000)
        wait(NS_PER_S)
    view.send_signal(signal.SIGINT)
    assert view.wait(10) == 0
    for entity in ("/axis1/speed/measured", "/axis1/torque/command"):
        for own, sent in zip(numbers(folder / "run.rrd", entity), numbers(seen, entity), strict=True):
            assert (own == sent).all()
    with pytest.raises(OSError, match="refused"):
        urlopen(page, timeout=5)


def test_simulated_time_is_served_when_it_is_over(tmp_path: Path) -> None:
    run = start("run", str(EXAMPLES / "ling2012.toml"), "--serve", "--record", str(tmp_path / "run"))
    assert run.wait(60) == 2
    assert run.stderr is not None
    assert run.stderr.read() == (
        "hil: error: --serve: found 'simulated time', expected a run in real time; --time real beside it, or "
        "afterwards hil view RUN --serve\n"
    )
