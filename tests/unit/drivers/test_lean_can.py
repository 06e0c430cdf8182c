"""python-can does not load asammdf; whoever asks for it gets it."""

import subprocess
import sys

PROGRAM = """
import sys, drivers, can
print("asammdf" in sys.modules, can.Bus is not None)
import asammdf
print(asammdf.MDF is not None)
"""


def test_asammdf_is_for_those_who_ask() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True", "True"]
