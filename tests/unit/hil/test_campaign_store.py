"""The table of a campaign on disk: whole at any moment, and what is damaged is told."""

import os
import platform
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.store import RunStore, open_campaign, plan_in, stored_runs
from servobench.hil.campaign.sweep_file import sweep_from
from servobench.hil.campaign.worker import FIGURES

LING = Path(__file__).parents[3] / "examples" / "ling2012.toml"
KEY = "faults.loss.0.probability"


def plan(seeds: int = 100, source: str = "sweep.toml") -> CampaignPlan:
    tables = {
        "campaign": {"name": "try", "bench": str(LING), "seeds": seeds},
        "vary": [{"key": KEY, "values": [0.1, 0.2]}],
    }
    return CampaignPlan(sweep_from(tables, source), Path(source))


def row(number: int) -> dict[str, Any]:
    told: dict[str, Any] = {
        "weight": 1.0,
        "counts": True,
        "outcome": "passed",
        "passed": True,
        "completed": True,
        "reason": "",
        "certificate": "",
        "premises_left": "",
        "premises_unknown": "",
        "digest": f"{number:032x}",
    }
    figures = dict.fromkeys(FIGURES, 1.5) | {"after_load_percent": None}
    return {"run": number, "point": 0, "replicate": 0, "seed": number, KEY: 0.1, **told, **figures}


@pytest.fixture
def store(tmp_path: Path) -> Iterator[RunStore]:
    with open_campaign(tmp_path / "campaign", plan(), resume=False) as it:
        yield it


def reopened(store: RunStore) -> RunStore:
    """Both are unlocked, and can be read."""
    store.close()
    with open_campaign(store.folder, plan(), resume=True) as again:
        return again


def test_what_was_appended_is_read_with_units(store: RunStore) -> None:
    store.append([row(number) for number in range(3)])
    store.append([row(number) for number in range(3, 5)])
    table = reopened(store).table()
    assert table.to_pylist() == [row(number) for number in range(5)]
    assert table.schema.field("torque_rms_nm").metadata[b"unit"] == b"N m"
    assert table.schema.metadata[b"campaign"] == b"try"


def test_runs_are_appended_in_order_and_once(store: RunStore) -> None:
    store.append([row(0)])
    for numbers in ([0], [2], [1, 3]):
        with pytest.raises(ValueError, match="expected those from 1 on"):
            store.append([row(number) for number in numbers])


def test_a_file_that_was_being_written_is_not_there(store: RunStore, tmp_path: Path) -> None:
    store.append([row(0)])
    (tmp_path / "campaign" / "runs" / "part-000000001.writing").write_bytes(b"PAR1 half a fi")
    store.close()
    with open_campaign(store.folder, plan(), resume=True) as again:
        assert again.count == 1
        again.append([row(1)])
    assert [path.suffix for path in (tmp_path / "campaign" / "runs").iterdir()] == [".parquet"] * 2


def test_every_byte_that_changes_is_noticed(store: RunStore, tmp_path: Path) -> None:
    store.append([row(number) for number in range(50)])
    store.close()
    folder = tmp_path / "campaign"
    (part,) = (folder / "runs").iterdir()
    for path in (part, folder / "campaign.json", folder / "seal"):
        whole = path.read_bytes()
        for place in range(0, len(whole), 97):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
            with pytest.raises(BadInput, match=path.name):
                stored_runs(folder, store.schema)
        path.write_bytes(whole)
    assert reopened(store).count == 50


def test_a_missing_or_shortened_file_is_told(store: RunStore, tmp_path: Path) -> None:
    for number in range(3):
        store.append([row(number)])
    paths = sorted((tmp_path / "campaign" / "runs").iterdir())
    paths[2].write_bytes(paths[2].read_bytes()[:-20])
    for path in (paths[2], paths[0]):
        with pytest.raises(BadInput, match=r"runs/part-00000000[02].parquet: found 'BLAKE2b "):
            reopened(store)
        path.unlink(missing_ok=True)
    with pytest.raises(BadInput, match=r"part-000000000.parquet: found 'BLAKE2b no file'"):
        reopened(store)


@pytest.mark.parametrize("other", ["part-000000001.parquet", "../other/runs/part-000000000.parquet"])
def test_parts_that_have_changed_places_are_told(store: RunStore, tmp_path: Path, other: str) -> None:
    """With one of the same store, or of the same place in another campaign's."""
    runs = tmp_path / "campaign" / "runs"
    for number in range(2):
        store.append([row(number)])
    with open_campaign(tmp_path / "other", plan(), resume=False) as beside:
        beside.append([row(0) | {"outcome": "not passed", "passed": False}])
    first, second = runs / "part-000000000.parquet", (runs.parent if "/" in other else runs) / other
    held = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(held)
    with pytest.raises(BadInput, match=r"part-000000000.parquet: found 'BLAKE2b "):
        reopened(store)


def test_a_part_that_no_run_of_the_campaign_has_written_is_told(store: RunStore, tmp_path: Path) -> None:
    store.append([row(0)])
    runs = tmp_path / "campaign" / "runs"
    shutil.copy(runs / "part-000000000.parquet", runs / "part-000000001.parquet")
    with pytest.raises(BadInput, match=r"part-000000001.parquet: found 'a file'"):
        reopened(store)


@pytest.mark.parametrize("name", ["runs/part-000000001.parquet", "campaign.json"])
def test_a_campaign_that_was_killed_before_a_file_was_in_its_place_goes_on(
    store: RunStore, tmp_path: Path, name: str
) -> None:
    store.append([row(0)])
    store.append([row(1)])
    store.close()
    folder = tmp_path / "campaign"
    lines = (folder / "seal").read_text().splitlines(keepends=True)
    place = folder / name
    last = next(number for number, line in enumerate(lines) if name in line)
    for path in [] if name == "campaign.json" else [folder / "runs" / "part-000000001.parquet"]:
        path.rename(path.with_suffix(".writing"))
    if name == "campaign.json":
        place.rename(place.with_suffix(".writing"))
        shutil.rmtree(folder / "runs")
    (folder / "seal").write_text("".join(lines[: last + 1]))
    with pytest.raises(BadInput, match=r"no last line|expected the folder of a campaign"):
        plan_in(folder)
    with open_campaign(folder, plan(), resume=True) as again:
        assert again.count == (0 if name == "campaign.json" else 2)
    assert (folder / "seal").read_text().endswith("}\n")
    assert '"ended"' in (folder / "seal").read_text().splitlines()[-1]


def test_a_folder_is_of_one_campaign(store: RunStore, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=rf"process {os.getpid()} on {platform.node()} does"):
        open_campaign(tmp_path / "campaign", plan(), resume=True)
    store.close()
    with pytest.raises(BadInput, match="--resume goes on with it"):
        open_campaign(tmp_path / "campaign", plan(), resume=False)
    with pytest.raises(BadInput, match="expected the sweep as it was when the campaign began"):
        open_campaign(tmp_path / "campaign", plan(seeds=7), resume=True)
    with pytest.raises(BadInput, match=r"it holds the campaign of .*sweep.toml"):
        open_campaign(tmp_path / "campaign", plan(source="other.toml"), resume=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    with pytest.raises(BadInput, match="a new or empty folder"):
        open_campaign(tmp_path / "other", plan(), resume=False)
    assert isinstance(store.schema, pa.Schema)
