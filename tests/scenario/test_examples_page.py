"""docs/examples.md shows every example with picture and command, and the notebook does what it says."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")
NOTEBOOK = ROOT / "examples" / "notebooks" / "recording.ipynb"
BENCHES = sorted(path.stem for path in (ROOT / "examples").glob("*.toml"))


@pytest.mark.parametrize("name", BENCHES)
def test_an_example_has_its_picture_a_paragraph_and_its_command(name: str) -> None:
    [section] = [each for each in PAGE.split("\n## ") if f"hil run examples/{name}.toml" in each]
    [picture] = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", section)
    assert picture == f"gallery/{name}.png"
    assert len(section.split("\n\n")[1].split()) > 10
    with Image.open(ROOT / "docs" / picture) as image:
        colours = image.convert("RGB").getcolors()
    assert colours is not None
    assert len(colours) > 8


def test_the_gallery_has_no_picture_of_what_is_gone() -> None:
    assert sorted(path.stem for path in (ROOT / "docs" / "gallery").glob("*.png")) == sorted(
        [*BENCHES, "notebook"]
    )


def test_the_notebook_runs_from_recording_to_picture(tmp_path: Path) -> None:
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], len({cell["id"] for cell in notebook["cells"]})) == (
        4,
        len(notebook["cells"]),
    )
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    folder = tmp_path / "examples" / "notebooks"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join("".join(cell["source"]) for cell in cells)],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "TMPDIR": str(tmp_path)},
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = re.fullmatch(r"(\d+) of 2000 cycles, (\d+) in a row\n", done.stdout)
    assert told is not None, done.stdout
    assert 2000 > int(told[1]) >= int(told[2]) > 1
    with Image.open(folder / "from-recording.png") as image:
        assert np.asarray(image.convert("L")).std() > 10
