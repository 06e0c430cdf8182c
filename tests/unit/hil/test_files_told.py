"""What is said of files with a value that does not belong there."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config_files import Section, validated
from servobench.hil.configuration.controller_kinds import ControllerFile
from servobench.hil.configuration.motor_file import MotorFile
from tests.told import ROOT, hold, struck

KINDS: Final = re.compile(r"one of 'pid'(, '\w+')+")
"""Of controllers: one more changes no text here (they are listed in test_config.py)."""
EXAMPLES: Final = ROOT / "examples"
FILES: Final[dict[str, type[Section] | None]] = {
    "ling2012.toml": None,
    "three_axes.toml": None,
    "position_csv.toml": None,
    "position_csp.toml": None,
    "network_designed.toml": None,
    "load_machine.toml": None,
    "own_controller/mpc.toml": None,
    "motors/ling2012.toml": MotorFile,
    "controllers/ling2012-static.toml": ControllerFile,
    "controllers/ling2012-hinf.toml": ControllerFile,
}


def loader(name: str) -> Callable[[dict[str, Any]], object]:
    model = FILES[name]
    if model is None:
        return lambda tables: bench_from(tables, name, (EXAMPLES / name).parent)
    return lambda tables: validated(model, tables, name)


@pytest.mark.long
@pytest.mark.parametrize("name", FILES)
def test_what_is_told_of_a_bad_file(name: str) -> None:
    tables = tomllib.loads((EXAMPLES / name).read_text(encoding="utf-8"))
    told = Path(name).with_suffix("").as_posix().replace("/", "-")
    lines = struck(tables, loader(name))
    hold(KINDS.sub("one of KINDS", "\n".join(lines)), Path(__file__).with_name("told") / f"file_{told}.txt")
