"""What every test gets: assertions of helpers that tell, and a second try in real time where it is owed.

A test of the group "real time", or on vcan or a controller, needs a machine that wakes a process in time.
One that failed while the machine did not (see :mod:`tests.stillness`) says nothing yet, and is tried again,
three times in all, twice on an emulated machine. A failure on a machine that kept its time stands; so does
what was told wrongly, however late all were. Beside other workers these tests are in the first, which `make
test` lets go before the others.

A test that its time-out does not end (it waits where no signal is heard, or swallows what is raised) would
hold up the whole run without a word: a thread of C prints where every thread stands, and ends the worker. So
ends a worker that does not come to its own end.

An emulated machine (SERVOBENCH_EMULATED: User Mode Linux, QEMU) may stand still in both. A few tests for
which it did are left out, by name, and one more for each test that passed although it stood still: what is
broken makes no machine stand still for what is not. What more there are fail. Where the time is limited
(SERVOBENCH_SECONDS), what has not begun by then is skipped.
"""

import faulthandler
import gc
import os
import signal
import sys
from collections.abc import Generator, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer.testing

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from tests.stillness import EMULATED, EXCUSED_MS, STOOD_STILL_MS, Untrue, Witness

pytest.register_assert_rewrite("tests.contract", "tests.scenario", "tests.truth")

TRIES = 2 if EMULATED else 3
"""Starting a program takes an emulated machine half a minute."""
LEFT_OUT_MAX = 3
GRACE_S = 60.0
"""What clearing up after a time-out may take, beside other work, before the worker is ended."""
REAL_TIME = "real time"
UNIT = Path(__file__).parent / "unit"
ON_LINUX = {Path(__file__).parent / each for each in ("can", "vcan")}
_witness: Witness | None = None
"""One for each worker, made when it is first needed."""
_left_out: list[str] = []
_passed_late: list[str] = []
"""Tests that an emulated machine passed although it stood still."""
_NO_TIME = "no time left for it"
_CLOCK = MonotonicClock()
_BEGAN_AT = _CLOCK.now()
_errors_to: list[int] = []
"""Standard error as it is outside of a test, whose own is captured."""
_ORDER = pytest.StashKey[tuple[bool, bool]]()
"""Of a test: whether it needs no real time, and whether it is a quick unit test."""


def pytest_configure() -> None:
    """Tests send signals that nohup, and a shell for what it leaves in the background, have had ignored.

    And CliRunner would make all commands of ``hil`` anew for each that it is asked for.
    """
    _errors_to.append(os.dup(2))
    vars(typer.testing)["_get_command"] = cache(typer.main.get_command)
    for number, handler in ((signal.SIGHUP, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is collected lasts: no collector looks for garbage in it, now or later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the tests in real time their further tries; they go first, then all but the quick unit tests.

    Hypothesis would read all sources for constants to draw: ten seconds of each worker, and other draws
    wherever other modules are imported.
    """
    if (providers := sys.modules.get("hypothesis.internal.conjecture.providers")) is not None:
        vars(providers)["_get_local_constants"] = lambda: vars(providers)["_local_constants"]
    long = {item.path for item in items if item.get_closest_marker("long")}
    of_path = {path: ({*path.parents}, path in long) for path in {item.path for item in items}}
    for item in items:
        above, is_long = of_path[item.path]
        group = item.get_closest_marker("xdist_group")
        in_real_time = not ON_LINUX.isdisjoint(above) or (group is not None and REAL_TIME in group.args)
        item.stash[_ORDER] = (not in_real_time, UNIT in above and not is_long)
        if in_real_time:
            item.add_marker(pytest.mark.flaky(reruns=TRIES - 1, condition=_is_excused))
    items.sort(key=lambda item: item.stash[_ORDER])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hand out file by file, so that what a module sets up is set up once; to the first worker real time."""
    if config.getoption("dist") != "loadgroup":
        return None
    config.option.loadscopereorder = False
    scheduler = import_module("xdist.scheduler").LoadGroupScheduling(config, log)
    group_of, schedule = scheduler._split_scope, scheduler.schedule

    def begin_with_the_first() -> None:
        by_name = sorted(scheduler.assigned_work.items(), key=lambda entry: str(entry[0].gateway.id))
        scheduler.assigned_work = dict(by_name)
        schedule()

    remove_node = scheduler.remove_node

    def remove_with_its_test(node: Any) -> str | None:
        pending = (
            (unit, test) for unit in scheduler.assigned_work[node].values() for test in unit if not unit[test]
        )
        unit, crashed = next(pending, (None, None))
        if unit is not None:
            unit[crashed] = True  # else the test that ended its worker is handed to the next one, for ever
        remove_node(node)
        return crashed

    scheduler.schedule, scheduler.remove_node = begin_with_the_first, remove_with_its_test
    # a test without a group is a scope of its own there
    scheduler._split_scope = lambda node_id: group_of(node_id).partition("::")[0]
    return scheduler


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, object, object]:
    """A worker that a test does not give back is ended, once it has had the time of all its tries.

    Behind the last test in real time nobody watches the machine: that costs a fiftieth of a core.
    """
    global _witness
    marker = item.get_closest_marker("timeout")
    limit_s = marker.args[0] if marker else item.config.getini("timeout")
    if limit_s:
        _end_after(item.config, float(limit_s) * (TRIES if _is_in_real_time(item) else 1) + GRACE_S)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()
        if _witness is not None and nextitem is not None and not _is_in_real_time(nextitem):
            _witness.stop()
            _witness = None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """The machine is watched while a test in real time runs."""
    global _witness
    if _CLOCK.now() - _BEGAN_AT > float(os.environ.get("SERVOBENCH_SECONDS", "inf")) * NS_PER_S:
        pytest.skip(_NO_TIME)
    if _is_in_real_time(item):
        _witness = _witness or Witness()
        _witness.begin()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """What the machine did is told with a failure."""
    report = yield
    if _witness is None or not _is_in_real_time(item):
        return report
    if report.passed and report.when == "call" and _witness.late_ms() >= STOOD_STILL_MS:
        _passed_late.append(item.nodeid)
    if report.failed:
        told = f"kept a process waiting for {_witness.late_ms()} ms"
        report.sections.append(("The machine", told))
        if _is_left_out(item, call):
            _left_out.append(item.nodeid)
            report.outcome, report.longrepr = "skipped", (str(item.path), 0, f"the machine {told}")
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name what was left out, and how many tests nobody had time for."""
    for name in _left_out:
        terminalreporter.line(f"left out, as the emulated machine stood still {TRIES} times: {name}")
    skipped = terminalreporter.stats.get("skipped", [])
    if not_begun := [report.nodeid for report in skipped if _NO_TIME in report.longrepr[2]]:
        terminalreporter.line(f"no time left for {len(not_begun)} tests, the first {not_begun[0]}")


def pytest_runtest_teardown(item: pytest.Item) -> None:
    """No process outlives its test."""
    if _is_in_real_time(item):
        from tests.scenario.processes import (
            end_what_is_left,  # its assertions are rewritten only from here on
        )

        end_what_is_left()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Nothing is left running."""
    if hasattr(session.config, "workerinput"):
        _end_after(session.config, 2 * GRACE_S)
    if _witness is not None:
        _witness.stop()


@pytest.fixture(scope="module")
def forked_children() -> Iterator[None]:
    """Loggers, workers and hubs that the tests of a module start from their own process are forked."""
    from tests.warm.start import python

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "executable", python())
        yield


@pytest.fixture(scope="module")
def unviewed_recordings() -> Iterator[None]:
    """What is forked has no Rerun: run.rrd takes the logger of a short run half of its time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("UNVIEWED", "1")
        yield


@pytest.fixture(scope="module")
def undrawn_certificates() -> Iterator[None]:
    """Commissionings leave a PDF without pages: to draw them takes a third of the time of all their steps."""
    from servobench.hil.commissioning import certificate_pdf

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate_pdf, "write_pdf", lambda _made, path: path.write_bytes(b"%PDF-"))
        yield


def _end_after(config: pytest.Config, seconds: float) -> None:
    if not config.getoption("usepdb"):
        faulthandler.dump_traceback_later(seconds, file=_errors_to[0], exit=True)


def _is_in_real_time(item: pytest.Item) -> bool:
    return not item.stash[_ORDER][0]


def _is_left_out(item: pytest.Item, call: pytest.CallInfo[None]) -> bool:
    return (
        EMULATED
        and len(_left_out) < LEFT_OUT_MAX + len(_passed_late)
        and getattr(item, "execution_count", 0) >= TRIES
        and call.excinfo is not None
        and not isinstance(call.excinfo.value, Untrue)
        and _witness is not None
        and _witness.late_ms() >= STOOD_STILL_MS
    )


def _is_excused(error: BaseException) -> bool:
    assert _witness is not None
    return _witness.late_ms() >= EXCUSED_MS and not isinstance(error, Untrue)
