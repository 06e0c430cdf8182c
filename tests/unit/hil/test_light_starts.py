"""Processes that simulate no drive start without what only a simulated drive needs."""

import subprocess
import sys

import pytest

from virtual_bus.bus import bit_length


@pytest.mark.long
@pytest.mark.skipif(
    bit_length.frame_bits.__class__.__name__ == "function", reason="interpreted, numba counts bits"
)
@pytest.mark.parametrize(
    "module",
    [
        "hil.commissioning.session",
        "hil.execution.bench",
        "hil.inspecting.scanning",
        "hil.measuring.measure",
        "virtual_bus.bus.hub_process",
    ],
)
def test_numba_is_not_loaded(module: str) -> None:
    code = f"import sys, {module}; print(*sorted({{'numba', 'llvmlite'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
