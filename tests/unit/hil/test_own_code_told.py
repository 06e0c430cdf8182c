"""All that is said of code of one's own that cannot be had, made or used, and where it is found."""

import importlib
import math
import re
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.control import setup
from servobench.hil.control.own_code import (
    OBJECT_PATTERN,
    OwnCodeFailed,
    guarded_compensator,
    guarded_controller,
    object_of,
    source_of,
)
from servobench.hil.loop.protocol import TorqueSetPoint
from tests.unit.hil.cycles import in_cycle
from tests.unit.hil.test_own_code import CODE, SETUP, controller, line_of

OUTPUT = f"mine.py:{line_of('    def output')} in output"
SET_POINTS = "a TorqueSetPoint, SpeedSetPoint or PositionSetPoint"


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(CODE)
    return path


def failure_of(call: Callable[[], object]) -> str:
    with pytest.raises(OwnCodeFailed) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (None, f"{OUTPUT} returned None, expected {SET_POINTS}"),
        ("0.5", f"{OUTPUT} returned '0.5', expected {SET_POINTS}"),
        (math.nan, f"{OUTPUT} returned TorqueSetPoint(torque_nm=nan), expected a number"),
        (-math.inf, f"{OUTPUT} returned TorqueSetPoint(torque_nm=-inf), expected a number"),
    ],
)
def test_an_answer_that_is_of_no_use(mine: Path, answer: object, told: str) -> None:
    made = controller(mine, answer=answer)
    assert failure_of(lambda: made.output(in_cycle())) == f"axis1: the controller Mine failed: {told}"


def test_telemetry_of_another_length(mine: Path) -> None:
    made = controller(mine, told=(1, 2.5))
    line = line_of("    def telemetry")
    assert failure_of(made.telemetry) == (
        f"axis1: the controller Mine failed: mine.py:{line} in telemetry returned [1.0, 2.5], expected a "
        "value for each of ('gain',)"
    )


def test_a_call_that_raises_and_one_that_does_not_come_back(mine: Path) -> None:
    line = line_of('raise RuntimeError("no solution")')
    assert failure_of(controller(mine, fails="reset").reset) == (
        f"axis1: the controller Mine failed: mine.py:{line} in may_fail: RuntimeError: no solution"
    )
    spinning = guarded_compensator(f"{mine}:Own", {"fails": "spin"}, replace(SETUP, patience_s=0.06))
    told = failure_of(spinning.reset)
    assert re.fullmatch(
        r"axis1: the compensator Own did not come back within 0\.06 s: mine\.py:\d+ in may_fail", told
    )


def test_a_call_of_another_thread_is_let_be(mine: Path) -> None:
    """No signal comes to it; the next call of this one has its own time."""
    made = controller(mine, replace(SETUP, patience_s=0.0))
    answers: list[object] = []
    thread = threading.Thread(target=lambda: answers.append(made.output(in_cycle())))
    thread.start()
    thread.join()
    assert answers == [TorqueSetPoint(0.5)]


def said(call: Callable[[], object]) -> tuple[str, str, Any, str, str]:
    with pytest.raises(BadInput) as caught:
        call()
    error = caught.value
    return error.source, error.key, error.value, error.expected, error.remedy


@pytest.mark.parametrize(
    ("role", "make"), [("Controller", guarded_controller), ("Compensator", guarded_compensator)]
)
def test_a_class_that_cannot_be_had(mine: Path, role: str, make: Callable[..., object]) -> None:
    expected = f"a class derived from servobench.{role}, as MODULE:NAME or FILE.py:NAME"
    key = f"drive.axis1.{role.lower()}.object"
    remedy = "there is Mine, Observed" if role == "Controller" else "there is Own"
    for other in ("Absent", "math", "StateEstimate"):
        name = f"{mine}:{other}"
        assert said(lambda name=name: make(name, {}, SETUP)) == ("bench.toml", key, name, expected, remedy)  # type: ignore[misc]
    name = "math:Mine"
    assert said(lambda: make(name, {}, SETUP)) == ("bench.toml", key, name, expected, "math has none")
    name = "no_such_module:Mine"
    remedy = "ModuleNotFoundError: No module named 'no_such_module'"
    told = ("bench.toml", key, name, "a module that Python can load", remedy)
    assert said(lambda: make(name, {}, SETUP)) == told


@pytest.mark.parametrize(
    ("added", "told"),
    [
        ("retrun 3", "mine.py:{line}: SyntaxError: invalid syntax: retrun 3"),
        ("import no_such", "mine.py:{line}: ModuleNotFoundError: No module named 'no_such'"),
        ("1 / 0", "mine.py:{line}: ZeroDivisionError: division by zero"),
    ],
)
def test_a_file_that_python_does_not_load(mine: Path, added: str, told: str) -> None:
    mine.write_text(f"{CODE}\n{added}\n")
    line = len(CODE.splitlines()) + 2
    _, _, _, expected, remedy = said(lambda: guarded_controller(f"{mine}:Mine", {}, SETUP))
    assert (expected, remedy) == ("a file that Python can load", told.format(line=line))


def test_a_class_without_the_method_that_it_needs(tmp_path: Path) -> None:
    path = tmp_path / "empty.py"
    path.write_text(
        "from servobench import Compensator, Controller\n"
        "class Idle(Controller):\n    def outputs(self, context):\n        pass\n"
        "class Blind(Compensator):\n    pass\n"
    )
    expected = "a class with the method {}, see hil docs own-controller"
    assert said(lambda: guarded_controller(f"{path}:Idle", {}, SETUP))[3] == expected.format("output")
    assert said(lambda: guarded_compensator(f"{path}:Blind", {}, SETUP))[3] == expected.format("estimate")


@pytest.mark.parametrize("method", ["channels", "telemetry"])
def test_names_and_values_that_are_none(tmp_path: Path, method: str) -> None:
    path = tmp_path / "c.py"
    path.write_text(
        "from servobench import Controller\n"
        "class C(Controller):\n    def __init__(self, setup):\n        pass\n"
        "    def output(self, context):\n        pass\n"
        f"    def {method}(self):\n        pass\n"
    )
    told = failure_of(lambda: guarded_controller(f"{path}:C", {}, SETUP).telemetry())
    expected = {"channels": "a tuple of names", "telemetry": "a value for each of ()"}[method]
    assert told == f"axis1: the controller C failed: c.py:7 in {method} returned None, expected {expected}"


def test_parameters_that_a_class_does_not_take(mine: Path) -> None:
    name = f"{mine}:Mine"
    assert said(lambda: guarded_controller(name, {"gain": 1.0}, SETUP)) == (
        "bench.toml",
        "drive.axis1.controller.parameters.gain",
        1.0,
        "no such key",
        "known here: answer, channels, told, fails",
    )


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "drive.axis1.controller.parameters.gain: missing, expected a value: {} has no default for it"),
        (
            {"gain": 1.0, "bandwith_hz": 2.0},
            "drive.axis1.controller.parameters.bandwith_hz: found 2.0, expected bandwidth_hz, "
            "the nearest known key; known here: gain, bandwidth_hz",
        ),
        (
            {"gain": "high"},
            "drive.axis1.controller.parameters: found {{'gain': 'high'}}, expected values that {} "
            "can be made with; own.py:4: TypeError: can't multiply sequence by non-int of type 'float'",
        ),
    ],
)
def test_a_class_is_made_with_its_own_parameters(tmp_path: Path, given: dict[str, Any], told: str) -> None:
    path = tmp_path / "own.py"
    path.write_text(
        "from servobench import Controller\n"
        "class Own(Controller):\n    def __init__(self, setup, gain, *, bandwidth_hz=1.0):\n"
        "        self.gain = gain * 2.0\n"
        "    def output(self, context):\n        pass\n"
    )
    name = f"{path}:Own"
    with pytest.raises(BadInput) as caught:
        guarded_controller(name, given, SETUP)
    assert str(caught.value) == f"bench.toml: {told.format(name)}"
    guarded_controller(name, {"gain": 1.0, "bandwidth_hz": 2.0}, SETUP)


def test_a_class_may_take_whatever_is_given(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(
        "from servobench import Controller\n"
        "class Own(Controller):\n    def __init__(self, setup, **given):\n"
        "        assert given == {'gain': 1.0}\n    def output(self, context):\n        pass\n"
    )
    guarded_controller(f"{path}:Own", {"gain": 1.0}, SETUP)


def test_channels_that_no_table_takes(mine: Path) -> None:
    name = f"{mine}:Mine"
    assert said(lambda: guarded_controller(name, {"channels": ("Gain",)}, SETUP)) == (
        name,
        "channels",
        ("Gain",),
        "at most 8 names of small letters, digits and _",
        "",
    )


# ---- where it is -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("a.b:C", True), ("a:C", True), ("_a1.b_2:C_3", True), ("x/y z.py:C", True), ("../m.py:_C", True),
        ("a.b", False), (":C", False), ("a:", False), ("1a:C", False), ("a:1", False), ("a/b:C", False),
        (".py:C", False), ("a:b.c", False), ("a.py:B:C", False),
    ],
)  # fmt: skip
def test_what_names_an_object(text: str, names: bool) -> None:
    assert (re.match(OBJECT_PATTERN, text) is not None) is names


def test_the_source_of_a_module_is_its_file() -> None:
    path = Path(str(setup.__file__))
    digest = blake2b(path.read_bytes(), digest_size=16).hexdigest()
    assert source_of("servobench.hil.control.setup:Setup") == (path, digest)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("none.py:Mine", "there is no file none.py"),
        ("no_such_module:Mine", "there is no module no_such_module"),
        ("no_such.package:Mine", "there is no module no_such.package"),
        ("sys:path", "there is no file built-in"),
    ],
)
def test_a_source_that_is_not_there_is_named(name: str, told: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(told)}$"):
        source_of(name)


def test_a_file_finds_what_is_beside_it_and_leaves_no_trace_in_the_path(tmp_path: Path) -> None:
    (tmp_path / "beside_own_code.py").write_text("GAIN = 0.25\n")
    path = tmp_path / "first.py"
    path.write_text("from beside_own_code import GAIN\n\nclass Mine:\n    gain = GAIN\n")
    before = list(sys.path)
    assert object_of(f"{path}:Mine").gain == 0.25
    assert sys.path == before
    assert f"controller file {path}" in sys.modules, "where dataclasses look for it"
    broken = tmp_path / "broken.py"
    broken.write_text("raise KeyError('no')\n")
    with pytest.raises(KeyError):
        object_of(f"{broken}:Mine")
    assert sys.path == before
    del sys.modules["beside_own_code"]
    importlib.invalidate_caches()
