"""Processes that simulate no drive start without what only a simulated drive needs."""

import subprocess
import sys
from types import FunctionType

import pytest

from virtual_bus.bus.bit_length import frame_bits


@pytest.mark.long
@pytest.mark.skipif(isinstance(frame_bits, FunctionType), reason="interpreted: numba counts bits")
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
