"""What a guarded controller says of an error that has no line of Python."""

from pathlib import Path

import pytest

from drivers.timebase import NS_PER_MS, Duration
from hil.configuration.motor_file import LING2012
from hil.control.own_code import OwnCodeFailed, guarded_controller, source_of
from hil.control.setup import Setup
from hil.loop.samples import AT_REST
from tests.unit.hil.cycles import in_cycle

SETUP = Setup("axis1", Duration(NS_PER_MS), LING2012.parameters, 5.0, 250.0, 1.0, "bench.toml")


def test_an_error_out_of_a_library_without_python_has_no_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "import math\nfrom hil import Controller\n\n\nclass Root(Controller):\n"
        "    output = math.sqrt\n\n    def __init__(self, setup):\n        pass\n"
    )
    controller = guarded_controller(f"{path}:Root", {}, SETUP)
    with pytest.raises(OwnCodeFailed, match="Root failed: in code that is not Python: TypeError"):
        controller.output(in_cycle(AT_REST))
    monkeypatch.chdir(tmp_path)
    assert source_of("mine.py:Root")[1] == source_of(f"{path}:Root")[1]
