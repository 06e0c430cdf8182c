"""Compiled, interpreted and mixed, a run gives the same records: the interpreted source is the reference."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from servobench.drivers.compiled import PURE, ROOMS, look
from tests.draws import few_of

ROOT = Path(__file__).parents[2]
SHORT_S = 0.5
EDITED: dict[str, tuple[str, set[str]]] = {
    "wire": ("drivers/timebase.py", set()),
    "loop": ("hil/loop/axis.py", {"wire", "bus", "device"}),
    "bus": ("virtual_bus/bus/host_port.py", {"wire", "loop"}),
    "device": ("virtual_bus/drive/servo.py", {"wire", "loop", "bus"}),
}
"""Group -> a module of it, and the groups that stay compiled when that is edited."""
FIRST_OF = {
    "wire": "servobench.drivers.timebase",
    "loop": "servobench.hil.loop.axis",
    "bus": "servobench.virtual_bus.bus.host_port",
    "device": "servobench.virtual_bus.drive.servo",
}

pytestmark = pytest.mark.skipif(not look().compiled, reason="nothing is compiled: make compile")

RUN = f"""
import atexit, sys
from servobench.hil.cli import main
names = {list(FIRST_OF.values())}
atexit.register(lambda: print("files", *(sys.modules[name].__file__ for name in names), file=sys.stderr))
main()
"""


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The examples, with a bench of half a second."""
    examples = tmp_path_factory.mktemp("bench") / "examples"
    shutil.copytree(ROOT / "examples", examples)
    text = (examples / "ling2012.toml").read_text().replace("duration_s = 2.0", f"duration_s = {SHORT_S}")
    (examples / "short.toml").write_text(text.replace("at_s = 1.0", "at_s = 0.3"))
    return examples


def digest_of_run(
    checkout: Path, examples: Path, record: Path, **environment: str
) -> tuple[str, set[str], list[str]]:
    """Digest of a short run of the modules below ``checkout``, groups that ran compiled, and the notes."""
    done = subprocess.run(
        [sys.executable, "-c", RUN, "run", str(examples / "short.toml"), "--json", "--record", str(record)],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout), "CI": "1", **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1, 6), done.stderr
    said, _, files = done.stderr.rpartition("files ")
    compiled = {group for group, file in zip(FIRST_OF, files.split(), strict=True) if file.endswith(".so")}
    notes = [line for line in said.splitlines() if line.startswith("hil: note:")]
    notes = [line for line in notes if "never acts" not in line]  # faults behind the end of a short run
    return str(json.loads(done.stdout)["digest"]), compiled, notes


@pytest.fixture(scope="module")
def reference(examples: Path) -> str:
    """The digest of the interpreted sources."""
    digest, compiled, notes = digest_of_run(ROOT, examples, examples / "interpreted", **{PURE: "1"})
    assert (compiled, notes) == (set(), [])
    return digest


def test_the_compiled_modules_give_the_digest_of_the_sources(examples: Path, reference: str) -> None:
    digest, compiled, notes = digest_of_run(ROOT, examples, examples / "compiled")
    assert digest == reference
    assert (compiled, notes) == (set(FIRST_OF), [])


@pytest.mark.parametrize("group", few_of([*EDITED], 1))
def test_an_edit_takes_a_group_to_its_sources_with_one_line(
    tmp_path: Path, examples: Path, reference: str, group: str
) -> None:
    for room in ROOMS:
        shutil.copytree(ROOT / room, tmp_path / room)
    shutil.copytree(ROOT / "servobench", tmp_path / "servobench", symlinks=True)
    edited, still_compiled = EDITED[group]
    with (tmp_path / edited).open("a") as source:
        source.write("# edited\n")
    digest, compiled, notes = digest_of_run(tmp_path, examples, tmp_path / "run")
    assert digest == reference
    assert compiled == still_compiled
    assert len(notes) == 1
    assert edited in notes[0]
