"""What an edit compiles anew: its own group, and when a class layout changes, those that have it built in.

A small checkout of two groups, compiled by the setup.py of this one.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 600

POINT = """
class Point:
    def __init__(self, x: int, y: int) -> None:
        self.x = x
        self.y = y

    def total(self) -> int:
        return self.x + self.y
"""
READER = """
from servobench.drivers.point import Point


def read(point: Point) -> tuple[int, int, int]:
    return point.x, point.y, point.total()
"""
FILES = (
    "setup.py",
    "design/core/build.py",
    "drivers/__init__.py",
    "drivers/compiled.py",
    "drivers/lean_can.py",
    "virtual_bus/__init__.py",
)
"""Of this checkout: what compiles, and what looks at what was compiled."""
PROJECT = """
[project]
name = "small"
version = "0"
[tool.setuptools]
packages = []
"""
COMPILE = """
import functools, mypyc.build, sys, setup
made = mypyc.build.mypycify
mypyc.build.mypycify = lambda *given, **how: made(*given, **{**how, "opt_level": "0"})
setup.GROUPS = {"wire": ["drivers/point.py"], "bus": ["virtual_bus/reader.py"]}
sys.argv = ["setup.py", "--quiet", "build_ext", "--inplace"]
setup.main(sys.argv[1:])
"""
READ = """
import sys
from servobench.drivers.compiled import use_fresh
from servobench.drivers.point import Point
from servobench.virtual_bus.reader import read
print(*use_fresh().compiled, ":", *read(Point(1, 2)))
"""

pytestmark = pytest.mark.timeout(TIMEOUT_S)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Two modules, the second using a class of the first; not compiled yet."""
    for path in FILES:
        (tmp_path / path).parent.mkdir(exist_ok=True, parents=True)
        shutil.copy(ROOT / path, tmp_path / path)
    (tmp_path / "servobench").mkdir()
    for name in ("__init__.py", "design", "drivers", "hil", "virtual_bus"):
        shutil.copy(ROOT / "servobench" / name, tmp_path / "servobench", follow_symlinks=False)
    (tmp_path / "pyproject.toml").write_text(PROJECT)
    (tmp_path / "drivers" / "point.py").write_text(POINT)
    (tmp_path / "virtual_bus" / "reader.py").write_text(READER)
    return tmp_path


def said_by(program: str, checkout: Path) -> str:
    """What ``program``, run in the checkout, prints on its last line."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=checkout,
        env={
            name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "SERVOBENCH_PURE"}
        },
        capture_output=True,
        text=True,
        check=False,
        timeout=TIMEOUT_S,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


def test_a_group_is_compiled_anew_by_its_own_edits_and_by_layouts_that_it_uses(checkout: Path) -> None:
    point = checkout / "drivers" / "point.py"
    first = said_by(COMPILE, checkout)
    if first.startswith("Not compiled"):
        pytest.skip(first)
    assert first.startswith("Compiling wire, bus ")
    assert said_by(READ, checkout) == "wire bus : 1 2 3"
    assert said_by(COMPILE, checkout) == ""

    point.write_text(POINT.replace("self.x + self.y", "10 * self.x + self.y"))
    assert said_by(READ, checkout) == ": 1 2 12"
    assert said_by(COMPILE, checkout).startswith("Compiling wire ")
    assert said_by(READ, checkout) == "wire bus : 1 2 12"

    # an attribute in front: what the other group takes for y is x now
    point.write_text(POINT.replace("self.x = x", "self.w = 7\n        self.x = x"))
    assert said_by(READ, checkout) == ": 1 2 3"
    assert said_by(COMPILE, checkout).startswith("Compiling wire, bus ")
    assert said_by(READ, checkout) == "wire bus : 1 2 3"

    (checkout / "virtual_bus" / "reader.py").write_text(READER.replace("point.x,", "-point.x,"))
    assert said_by(READ, checkout) == "wire : -1 2 3"
    assert said_by(COMPILE, checkout).startswith("Compiling bus ")
    assert said_by(READ, checkout) == "wire bus : -1 2 3"
