"""What code of the user's put in the place of another function can be named."""

import colorsys
import sched
import subprocess
import sys
from collections.abc import Iterator

import pytest

from servobench.hil.machine.held_process import Modules, held_process


@pytest.fixture(autouse=True)
def spared() -> Iterator[None]:
    """Take back what the tests replace: in a module that nothing of the bench has, and a hook."""
    held, hook, path = dict(vars(colorsys)), sys.excepthook, [*sys.path]
    enter, code = sched.scheduler.enter, sched.scheduler.enter.__code__
    yield
    sys.path[:] = path
    sched.scheduler.enter = enter  # type: ignore[method-assign]
    enter.__code__ = code
    vars(colorsys).update(held)
    sys.modules["colorsys"], sys.excepthook = colorsys, hook


@pytest.mark.long
@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("colorsys.rgb_to_yiq = None", "colorsys.rgb_to_yiq"),
        ("colorsys.rgb_to_yiq = colorsys.yiq_to_rgb", "colorsys.rgb_to_yiq"),
        ("del colorsys.rgb_to_yiq", "colorsys.rgb_to_yiq"),
        ("del sys.modules['colorsys']", "sys.modules['colorsys']"),
        ("sys.path.clear()", "sys.path"),
        ("sys.path.insert(0, 'more')", ""),
        ("colorsys.more = print", ""),
        ("colorsys.ONE_THIRD = 0.3", ""),
        ("sys.excepthook = print", ""),
        ("sched.scheduler.enter = None", "sched.scheduler.enter"),
        ("sched.scheduler.more = print", ""),
        ("sched.scheduler.enter.__code__ = sched.scheduler.cancel.__code__", "sched.scheduler.enter"),
        (
            "colorsys.rgb_to_yiq = colorsys.yiq_to_rgb = colorsys.rgb_to_hls = colorsys.hls_to_rgb = None",
            "colorsys.hls_to_rgb, colorsys.rgb_to_hls, colorsys.rgb_to_yiq and 1 more",
        ),
    ],
)
def test_functions_and_modules_are_named_and_nothing_else(line: str, named: str) -> None:
    modules = Modules()
    modules.remember()
    assert modules.replaced() == ""
    exec(line)
    modules.remember()
    assert modules.replaced() == named


def test_a_process_that_is_no_command_s_remembers_nothing() -> None:
    """As pytest's: others have reasons to replace functions there."""
    code = (
        "import colorsys; from servobench.hil.machine.held_process import remember_modules, replaced; "
        "remember_modules(); colorsys.rgb_to_yiq = None; print([replaced()])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told == "['']\n"


def test_a_stack_that_is_made_shallow_is_as_deep_as_before() -> None:
    depth = sys.getrecursionlimit()
    with held_process():
        sys.setrecursionlimit(depth - 1)
    assert sys.getrecursionlimit() == depth
