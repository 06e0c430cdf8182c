"""A campaign's rows are all of the same files and the same program, whatever is edited on the way."""

import json
import os
import random
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.campaign import Campaign, CampaignProgress, run_campaign
from servobench.hil.campaign.store import StoreSeal
from servobench.hil.campaign.worker import NotTheSame
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import BadInputs, toml_text
from tests.scenario.test_campaign import CHANGES, LING

CONTROLLER = """
import json
import os
from pathlib import Path

import beside_own
from servobench import Controller, TorqueSetPoint

FOLDER = Path(__file__).parent


class Own(Controller):
    def __init__(self, setup):
        self.gain = json.loads((FOLDER / "gains.json").read_text())["gain"] * beside_own.FACTOR
        self.gain *= float(os.environ.get("OWN_FACTOR", "1"))
        try:
            self.gain *= json.loads((FOLDER / "extra.json").read_text())["factor"]
        except FileNotFoundError:
            pass

    def output(self, context):
        error = context.reference_rad_s - context.estimate.velocity_rad_s
        return TorqueSetPoint(self.gain * error)
"""
CHECK = """
from pathlib import Path
from threading import Thread


def check(seed, run):
    run()
    place = Path(__file__).parent / "gains.json"
    editor = Thread(target=place.write_text, args=('{"gain": 0.05}\\n',))
    editor.start()
    editor.join()
    return []
"""
FILES = {
    "own.py": CONTROLLER,
    "beside_own.py": "FACTOR = 1.00\n",
    "gains.json": '{"gain": 0.08}\n',
    "load.csv": "time_s,torque_nm\n0.0,0.00\n0.1,0.00\n0.2,0.25\n",
    "bench.toml": LING.read_text().replace('"motors/', f'"{LING.parent}/motors/'),
}
EDITED = {
    "own.py": CONTROLLER.replace("self.gain * error", "self.gain - error"),
    "beside_own.py": "FACTOR = 1.25\n",
    "gains.json": '{"gain": 0.05}\n',
    "load.csv": "time_s,torque_nm\n0.0,0.00\n0.1,0.00\n0.2,4.00\n",
    "bench.toml": FILES["bench.toml"].replace("seed = ", "seed=1"),
    "extra.json": '{"factor": 0.5}\n',
}
"""As long as they were, but for the one that is not there at first."""


def campaign(folder: Path, seeds: int = 4, **more: Any) -> Path:
    """Its sweep file, with all that it names."""
    folder.mkdir(exist_ok=True)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    tables = {
        "campaign": {"name": "edited", "bench": "bench.toml", "seeds": seeds, "failures_recorded": 0},
        "change": CHANGES
        | {
            "load": {"axis1": [{"kind": "file", "path": "load.csv"}]},
            "drive.axis1.controller": {"kind": "python", "object": "own.py:Own"},
        },
        **more,
    }
    path = folder / "sweep.toml"
    path.write_text(toml_text(tables))
    return path


def told(campaign: Campaign) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = campaign.table.to_pylist()
    return rows


def test_a_relative_path_names_the_same_campaign_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, here = CliRunner(), tmp_path / "here"
    campaign(here, seeds=2)
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "path", [*sys.path, "__editable__.another.finder.__path_hook__"])
    command = ["campaign", "sweep.toml", "--out", "out", "--workers"]
    ended = runner.invoke(app, [*command, "1", "--seconds", "0"])
    assert ended.exit_code == 0, ended.output
    ended = runner.invoke(app, [*command, "2", "--resume"])  # in another process: one run is left
    assert ended.exit_code == 0, ended.output
    identity = json.loads((here / "out" / "campaign.json").read_text())["identity"]
    assert {name for name in identity["files"] if "/" not in name} == {*FILES, "extra.json", "sweep.toml"}
    monkeypatch.chdir("/")
    whole = run_campaign(here / "sweep.toml", here / "out", resume=True, workers=1)
    assert whole.table.num_rows == 2
    assert Campaign.load(here / "out").replay(1).summary.digest == whole.column("digest")[1]
    moved = here.rename(tmp_path / "there")
    assert run_campaign(moved / "sweep.toml", moved / "out", resume=True).table.equals(whole.table)


class Editor:
    """Edits files at random, and knows which are not as they were."""

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder = folder
        self._draw = random.Random(seed)
        self.dirty: set[str] = set()

    def edit(self) -> None:
        name = self._draw.choice(sorted(EDITED))
        place = self._folder / name
        before = place.stat() if place.exists() else None
        match self._draw.choice(["edit", "edit unseen", "delete", "restore", "restore", "restore all"]):
            case "delete":
                place.unlink(missing_ok=True)
            case "edit":
                place.write_text(EDITED[name])
            case "edit unseen":
                place.write_text(EDITED[name])
                if before is not None:
                    os.utime(place, ns=(before.st_atime_ns, before.st_mtime_ns))
            case "restore":
                self._restore(name)
            case "restore all":
                self.restore()
        self._look()

    def restore(self) -> None:
        for name in EDITED:
            self._restore(name)
        self._look()

    def _look(self) -> None:
        self.dirty = {each for each in EDITED if self._text(each) != FILES.get(each)}

    def _text(self, name: str) -> str | None:
        place = self._folder / name
        return place.read_text() if place.exists() else None

    def _restore(self, name: str) -> None:
        if name in FILES:
            (self._folder / name).write_text(FILES[name])
        else:
            (self._folder / name).unlink(missing_ok=True)


@pytest.mark.timeout(1200)
def test_no_edit_between_runs_mixes_rows(tmp_path: Path) -> None:
    edits, seeds = int(os.environ.get("EDITS", "30")), 6  # make edits: 1000
    expected = told(run_campaign(campaign(tmp_path / "still", seeds), tmp_path / "alone", workers=1))
    path = campaign(tmp_path / "edited", seeds)
    editor, refused, accepted = Editor(path.parent, seed=edits), 0, 0

    def between(_: CampaignProgress) -> None:
        nonlocal accepted
        accepted += 1
        editor.edit()

    folders = (tmp_path / f"out-{number}" for number in range(edits))
    out = next(folders)
    for _ in range(edits):
        dirty = set(editor.dirty)
        try:
            done = run_campaign(path, out, resume=True, workers=1, progress=between)
        except (BadInput, BadInputs) as error:
            text = str(error)
        else:
            assert told(done) == expected
            editor.restore()
            out = next(folders)
            continue
        refused += 1
        assert any(name in text for name in dirty | editor.dirty), text
        editor.edit()
    assert refused > edits // 2
    assert accepted > edits // 8
    for folder in tmp_path.glob("out-*"):
        rows = told(Campaign(folder, done.plan)) if (folder / "runs").exists() else []
        assert rows == expected[: len(rows)]


def test_an_edit_during_a_run_ends_the_campaign(tmp_path: Path) -> None:
    path = campaign(tmp_path / "here", own={"check": "check.py:check"})
    (path.parent / "check.py").write_text(CHECK)
    with pytest.raises(BadInput, match=r"gains.json: found .BLAKE2b \w+., expected BLAKE2b"):
        run_campaign(path, tmp_path / "out", workers=1)
    assert not list((tmp_path / "out" / "runs").iterdir())


@pytest.fixture
def begun(tmp_path: Path) -> tuple[Path, Path]:
    path = campaign(tmp_path / "here")
    run_campaign(path, tmp_path / "out", workers=1, seconds=0.0)
    return path, tmp_path / "out"


def test_another_program_does_not_go_on(begun: tuple[Path, Path]) -> None:
    path, out = begun
    table = json.loads((out / "campaign.json").read_text())
    table["identity"]["program"] |= {"numpy": "1.26.4"}
    seal = StoreSeal(out, fresh=False)
    seal.put("campaign.json", json.dumps(table).encode())
    seal.close()
    with pytest.raises(BadInput, match=r"campaign.json: identity.program.numpy: found '1.26.4'"):
        run_campaign(path, out, resume=True, workers=1)


def test_what_is_in_no_file_is_noticed_by_the_last_run(
    begun: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = begun
    monkeypatch.setenv("OWN_FACTOR", "0.5")
    with pytest.raises(NotTheSame, match=f"run 0 comes to another row than is stored in {out}"):
        run_campaign(path, out, resume=True, workers=1)
