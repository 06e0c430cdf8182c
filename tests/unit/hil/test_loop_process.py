"""What the process of the loop is spared: every page that it touches is locked into memory in real time."""

import subprocess
import sys

KEPT_OUT = {"rerun", "pyarrow", "matplotlib", "cvxpy", "scipy.optimize"}


def test_a_run_loads_neither_the_viewer_nor_what_only_files_and_design_need() -> None:
    program = f"import sys, hil.execution.bench; print(sorted({KEPT_OUT!r} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
