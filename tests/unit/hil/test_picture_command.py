"""``hil picture``: what it refuses, and the figure for a paper."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.drivers.timebase import Instant
from servobench.hil.cli import app
from servobench.hil.recorded.recorded_run import open_run, signals_of
from servobench.hil.recorded.viewer import _pages
from servobench.hil.rows.run_files import RERUN_FILE
from tests.unit.hil.recorded_runs import short_run

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("forked_children")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the example."""
    return short_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["none", "a.png"], "the folder of a run"),
        (["none", "a.png", "--span", "1"], "--at beside it"),
        (["none", "a.txt"], "ends in .png"),
        (["none", "a.svg", "--paper", "--page", "zoom"], "no --paper beside it"),
    ],
)
def test_what_cannot_be_drawn_is_refused(tmp_path: Path, arguments: list[str], told: str) -> None:
    folder, out, *more = arguments
    found = CliRunner().invoke(app, ["picture", str(tmp_path / folder), str(tmp_path / out), *more])
    assert found.exit_code == 2
    assert told in found.output


@pytest.mark.parametrize(("suffix", "begin"), [(".svg", b"<?xml"), (".pdf", b"%PDF"), (".png", b"\x89PNG")])
def test_a_figure_for_a_paper(run: Path, tmp_path: Path, suffix: str, begin: bytes) -> None:
    out = tmp_path / f"figure{suffix}"
    found = CliRunner().invoke(app, ["picture", str(run), str(out), "--paper"])
    assert found.exit_code == 0, found.output
    assert out.read_bytes().startswith(begin)


def test_the_signals_are_those_of_the_rows(run: Path) -> None:
    opened = open_run(run / RERUN_FILE)
    signals = signals_of(opened)
    rows = np.concatenate(list(opened.rows()))
    times, load = signals.signals["axis1/torque/load"].points()
    assert times.tolist() == rows["due_at"].tolist()
    assert load.tolist() == rows["load_torque_nm"].tolist()
    assert Instant(int(times[0])) == 0


def test_pages_are_found_in_a_layout_by_the_names_of_their_tabs() -> None:
    def container(kind: str, name: str, *contents: str) -> dict[str, Any]:
        inner = contents[0] if len(contents) == 1 else list(contents)
        told: dict[str, Any] = {"container_kind": kind, "contents": inner, "display_name": name}
        return {"ContainerBlueprint": told}

    layout: dict[str, Any] = {
        "/container/root": container("Horizontal", "", "/container/tabs", "/view/text"),
        "/container/tabs": container("Tabs", "", "/container/all", "/container/zoom"),
        "/container/all": container("Vertical", "Overview", "/view/a", "/view/b"),
        "/container/zoom": container("Tabs", "Zoom", "/container/x"),
        "/container/x": container("Vertical", "axis1", "/view/c"),
    }
    front = ("/container/tabs", "/container/zoom")
    assert _pages(layout) == {
        "overview": [("/container/tabs", "/container/all")],
        "zoom": [front],
        "zoom/axis1": [front, ("/container/zoom", "/container/x")],
    }


def test_without_a_display_view_says_where_the_file_is(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr("servobench.hil.recording.page_keepers.subprocess.Popen", None)
    found = CliRunner().invoke(app, ["view", str(run)])
    assert found.exit_code == 0
    assert found.stdout.strip() == str(run / RERUN_FILE)
    assert "no display" in found.stderr


def test_with_a_display_view_starts_the_viewer(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    started: list[list[str]] = []
    monkeypatch.setattr(
        "servobench.hil.recording.page_keepers.subprocess.Popen", lambda command, **_: started.append(command)
    )
    found = CliRunner().invoke(app, ["view", str(run)])
    assert found.exit_code == 0
    assert started[0][-1] == str(run / RERUN_FILE)


def test_a_viewer_that_cannot_run_is_told_with_what_to_install(run: Path, tmp_path: Path) -> None:
    """Vulkan finds no driver where it is told to look elsewhere."""
    command = [sys.executable, "-m", "servobench.hil.cli", "picture", str(run), str(tmp_path / "page.png")]
    nowhere = {"VK_DRIVER_FILES": "/dev/null", "VK_ICD_FILENAMES": "/dev/null", "LIBGL_DRIVERS_PATH": "/"}
    found = subprocess.run(
        command, env={**os.environ, **nowhere}, capture_output=True, text=True, check=False
    )
    assert found.returncode == 3
    assert "mesa-vulkan-drivers" in found.stderr
