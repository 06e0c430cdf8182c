"""Compiled and interpreted, a run gives the same records: the interpreted source is the reference."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hil.machine.compiled import MANIFEST, compiled_modules

ROOT = Path(__file__).parents[2]
ROOMS = ("design", "drivers", "virtual_bus", "hil")
SHORT_S = 0.5

pytestmark = pytest.mark.skipif(not compiled_modules(ROOT), reason="nothing is compiled: make compile")

RUN = """
import sys, virtual_bus.timeline as hot
from hil.cli import main
print(hot.__file__, file=sys.stderr)
main()
"""


def digest_of_run(checkout: Path, folder: Path) -> tuple[str, str]:
    """Digest of a short run with the sources below ``checkout``, and what was said on stderr."""
    record = ["--record", str(folder / checkout.name)]
    done = subprocess.run(
        [sys.executable, "-c", RUN, "run", str(folder / "short.toml"), "--json", *record],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout), "CI": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1, 6), done.stderr
    return str(json.loads(done.stdout)["digest"]), done.stderr


def test_the_interpreted_sources_give_the_same_digest(tmp_path: Path) -> None:
    examples = tmp_path / "examples"
    shutil.copytree(ROOT / "examples", examples)
    text = (examples / "ling2012.toml").read_text().replace("duration_s = 2.0", f"duration_s = {SHORT_S}")
    (examples / "short.toml").write_text(text.replace("at_s = 1.0", "at_s = 0.3"))
    interpreted = tmp_path / "interpreted"
    leave_out = shutil.ignore_patterns("*.so", "__pycache__", Path(MANIFEST).name)
    for room in ROOMS:
        shutil.copytree(ROOT / room, interpreted / room, ignore=leave_out)
    fast, said_by_fast = digest_of_run(ROOT, examples)
    plain, said_by_plain = digest_of_run(interpreted, examples)
    assert ".so" in said_by_fast
    assert f"{interpreted}/virtual_bus/timeline.py" in said_by_plain
    assert fast == plain
