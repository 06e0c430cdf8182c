"""A controller and a compensator of one's own: what they may answer, and what is said of each failure."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.control.own_code import OwnCodeFailed, guarded_compensator, guarded_controller, source_of
from servobench.hil.control.setup import Setup
from servobench.hil.loop.protocol import CHANNELS_MAX, Compensator, Controller, TorqueSetPoint
from servobench.hil.loop.samples import AT_REST
from tests.unit.hil.cycles import in_cycle

SETUP = Setup("axis1", Duration(NS_PER_MS), LING2012.parameters, 5.0, 250.0, 60.0, "bench.toml")
COMMAND = Command(1, 0.0, Instant(0), Instant(0))
CODE = """
import math
from servobench.drivers.errors import BenchError
from servobench import Compensator, Controller, StateEstimate, TorqueSetPoint

class Mute(Exception):
    def __repr__(self):
        raise SystemExit(0)

    __str__ = __repr__

class Mine(Controller):
    def __init__(self, setup, answer=0.5, channels=("gain",), told=(1,), fails=""):
        self.answer, self.names, self.told, self.fails = answer, channels, told, fails

    def channels(self):
        return self.names

    def reset(self):
        self.may_fail("reset")

    def output(self, context):
        self.may_fail("output")
        return TorqueSetPoint(self.answer) if isinstance(self.answer, float) else self.answer

    def update(self, context, command):
        self.may_fail("update")

    def telemetry(self):
        self.may_fail("telemetry")
        return self.told

    def may_fail(self, method):
        if self.fails == method:
            raise RuntimeError("no solution")
        if self.fails == "mute":
            raise Mute
        if self.fails == "bus":
            raise BenchError("the bus is down")
        while self.fails == "spin":
            pass

class Own(Compensator):
    def __init__(self, setup, answer=None, fails=""):
        self.answer, self.fails = answer, fails

    def reset(self):
        self.may_fail("reset")

    def receive(self, sample):
        self.may_fail("receive")

    def sent(self, command):
        self.may_fail("sent")

    def estimate(self, context):
        self.may_fail("estimate")
        return self.answer

    may_fail = Mine.may_fail

class Observed(Mine):
    def observer(self):
        return Own(None, answer="an estimate")
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(CODE)
    return path


def controller(mine: Path, setup: Setup = SETUP, **parameters: object) -> Controller:
    return guarded_controller(f"{mine}:Mine", parameters, setup)


def compensator(mine: Path, **parameters: object) -> Compensator:
    return guarded_compensator(f"{mine}:Own", parameters, SETUP)


def line_of(text: str) -> int:
    return CODE[: CODE.index(text)].count("\n") + 1


def test_what_it_answers_is_handed_on(mine: Path) -> None:
    made = controller(mine, told=(2, 0.5), channels=("gain", "x_2"))
    made.reset()
    assert made.output(in_cycle()) == TorqueSetPoint(0.5)
    made.update(in_cycle(), COMMAND)
    assert (made.channels(), made.telemetry()) == (("gain", "x_2"), [2.0, 0.5])
    assert made.observer() is None
    assert compensator(mine, answer=AT_REST).estimate(in_cycle()) is AT_REST


@pytest.mark.parametrize("answer", [math.nan, math.inf, -math.inf])
def test_a_torque_is_a_number(mine: Path, answer: float) -> None:
    with pytest.raises(OwnCodeFailed, match=rf"axis1: the controller Mine .* returned .*{answer}.*a number"):
        controller(mine, answer=answer).output(in_cycle())


def test_what_cannot_say_what_it_is_fails_all_the_same(mine: Path) -> None:
    with pytest.raises(OwnCodeFailed, match=r"Mine failed: .*: Mute: what cannot be told \(SystemExit\)"):
        controller(mine, fails="mute").output(in_cycle())


@pytest.mark.parametrize("answer", [None, 1, "0.5", (0.5,)])
def test_an_output_is_a_set_point(mine: Path, answer: object) -> None:
    line = line_of("    def output")
    with pytest.raises(
        OwnCodeFailed, match=rf"mine\.py:{line} in output returned .*expected a TorqueSetPoint"
    ):
        controller(mine, answer=answer).output(in_cycle())


def test_an_estimate_is_an_estimate_of_an_observer_too(mine: Path) -> None:
    line = line_of("    def estimate")
    told = rf"the compensator Own failed: mine\.py:{line} in estimate returned .* expected a StateEstimate"
    observer = guarded_controller(f"{mine}:Observed", {}, SETUP).observer()
    assert observer is not None
    for made in (compensator(mine), observer):
        with pytest.raises(OwnCodeFailed, match=told):
            made.estimate(in_cycle())


@pytest.mark.parametrize("told", [(), (1.0, 2.0)])
def test_telemetry_has_a_value_for_each_channel(mine: Path, told: tuple[float, ...]) -> None:
    with pytest.raises(OwnCodeFailed, match=r"in telemetry returned .*a value for each of \('gain',\)"):
        controller(mine, told=told).telemetry()


@pytest.mark.parametrize(
    "channels", [("Gain",), ("2",), ("",), ("a b",), tuple(f"c{n}" for n in range(CHANNELS_MAX + 1))]
)
def test_channels_are_few_and_have_names_that_a_table_takes(mine: Path, channels: tuple[str, ...]) -> None:
    with pytest.raises(BadInput, match="at most 8 names of small letters") as caught:
        controller(mine, channels=channels)
    assert caught.value.key == "channels"
    controller(mine, channels=tuple(f"c{n}" for n in range(CHANNELS_MAX)))


CALLS: dict[str, Callable[[Any], object]] = {
    "reset": lambda made: made.reset(),
    "output": lambda made: made.output(in_cycle()),
    "update": lambda made: made.update(in_cycle(), COMMAND),
    "telemetry": lambda made: made.telemetry(),
    "receive": lambda made: made.receive(None),
    "sent": lambda made: made.sent(COMMAND),
    "estimate": lambda made: made.estimate(in_cycle()),
}


@pytest.mark.parametrize("method", CALLS)
def test_an_error_in_any_call_is_named_with_its_line(mine: Path, method: str) -> None:
    make = compensator if method in ("receive", "sent", "estimate") else controller
    line = line_of('raise RuntimeError("no solution")')
    with pytest.raises(
        OwnCodeFailed, match=rf"failed: mine\.py:{line} in may_fail: RuntimeError: no solution$"
    ):
        CALLS[method](make(mine, fails=method))
    with pytest.raises(OwnCodeFailed, match=r"may_fail: BenchError: the bus is down$"):
        CALLS[method](make(mine, fails="bus"))


@pytest.mark.parametrize("method", ["output", "update"])
def test_a_call_that_does_not_come_back_is_interrupted(mine: Path, method: str) -> None:
    made = controller(mine, replace(SETUP, patience_s=0.1), fails="spin")
    line = line_of('while self.fails == "spin"')
    with pytest.raises(
        OwnCodeFailed, match=rf"did not come back within 0\.1 s: mine\.py:({line}|{line + 1}) in may_fail"
    ):
        CALLS[method](made)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("none.py:Mine", "FileNotFoundError"),
        ("mine.py:Absent", "there is Mine, Observed"),
        ("mine.py:Own", "a class derived from servobench.Controller"),
        ("mine.py:math", "a class derived from servobench.Controller"),
    ],
)
def test_a_class_that_cannot_be_had_is_told_with_its_key(mine: Path, name: str, expected: str) -> None:
    with pytest.raises(BadInput, match=expected) as caught:
        guarded_controller(str(mine.parent / name), {}, SETUP)
    assert (caught.value.source, caught.value.key) == ("bench.toml", "drive.axis1.controller.object")


def test_parameters_that_it_does_not_take_are_told_with_their_key(mine: Path) -> None:
    with pytest.raises(BadInput, match="answer, channels, told, fails") as caught:
        controller(mine, gain=1.0)
    assert caught.value.key == "drive.axis1.controller.parameters.gain"
    with pytest.raises(BadInput) as caught:
        compensator(mine, gain=1.0)
    assert caught.value.key == "drive.axis1.compensator.parameters.gain"


def test_an_error_out_of_a_library_without_python_has_no_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "import math\nfrom servobench import Controller\n\n\nclass Root(Controller):\n"
        "    output = math.sqrt\n\n    def __init__(self, setup):\n        pass\n"
    )
    made = guarded_controller(f"{path}:Root", {}, SETUP)
    with pytest.raises(OwnCodeFailed, match="Root failed: in the call itself: TypeError"):
        made.output(in_cycle(AT_REST))
    monkeypatch.chdir(tmp_path)
    assert source_of("mine.py:Root")[1] == source_of(f"{path}:Root")[1]


@pytest.mark.parametrize("name", ["none.py:Mine", "no_such_module:Mine", "no_such.package:Mine"])
def test_a_source_that_is_not_there(name: str) -> None:
    with pytest.raises(ValueError, match="there is no"):
        source_of(name)
