"""What the two processes of a run are spared.

Every page that the loop touches is locked into memory in real time; the logger has to be there before a run
begins, also one of two seconds.
"""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.long

KEPT_OUT = {
    "servobench.hil.execution.bench": {"rerun", "pyarrow", "matplotlib", "cvxpy", "scipy"},
    "servobench.hil.recording.logger": {
        "scipy",
        "matplotlib",
        "cvxpy",
        "servobench.hil.configuration.config",
    },
}


@pytest.mark.parametrize("module", KEPT_OUT)
def test_a_process_of_a_run_loads_nothing_that_it_has_no_use_for(module: str) -> None:
    program = f"import sys, {module}; print(sorted({KEPT_OUT[module]!r} & set(sys.modules)))"
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"
