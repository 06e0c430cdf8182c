"""The table of a campaign on disk: a Parquet dataset that only grows, by whole files.

Each file holds the next runs in order of their number, is written beside its place, synced, and put there by
one rename: whatever is killed when, what is there is whole, and goes from run 0 on without a gap. The name of
a file ends with the BLAKE2b of its bytes, which is checked whenever it is read: Parquet's own checksums cover
the pages, and not what says how to read them.
"""

import hashlib
import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from drivers.bounded_file import parse_json, read_text
from drivers.errors import BadInput
from hil.campaign.plan import CampaignPlan
from hil.campaign.worker import FIGURES, Row
from hil.machine.on_disk import sync_folder, write_synced

FORMAT: Final = "1"
PLAN_FILE: Final = "campaign.json"
RUNS_FOLDER: Final = "runs"
_PART: Final = "part-{:09d}-{}.parquet"
_SUFFIX: Final = ".writing"


class RunStore:
    """Of one campaign, below its folder."""

    def __init__(self, folder: Path, schema: pa.Schema) -> None:
        """``folder``: of the campaign, which is there. Raises BadInput for one whose files are not whole."""
        self._runs = folder / RUNS_FOLDER
        self.schema = schema
        self._runs.mkdir(exist_ok=True)
        for left in self._runs.glob(f"*{_SUFFIX}"):
            left.unlink()
        self.count = self.table().num_rows
        """Runs that are stored: 0 to ``count`` - 1."""

    def append(self, rows: Sequence[Row]) -> None:
        """Store the next runs. Error: OSError."""
        numbers = [row["run"] for row in rows]
        if numbers != list(range(self.count, self.count + len(rows))):
            raise ValueError(f"runs {numbers[:3]}..., expected those from {self.count} on")
        if not rows:
            return
        sink = pa.BufferOutputStream()
        pq.write_table(pa.Table.from_pylist(list(rows), schema=self.schema), sink, compression="zstd")
        data = sink.getvalue().to_pybytes()
        place = self._runs / _PART.format(self.count, _checksum(data))
        beside = place.with_suffix(_SUFFIX)
        with beside.open("wb") as file:
            write_synced(file, data)
        beside.rename(place)
        sync_folder(self._runs)
        self.count += len(rows)

    def table(self) -> pa.Table:
        """All runs in order. Raises BadInput for a file that is damaged, or missing between others."""
        parts = []
        expected = 0
        for path in sorted(self._runs.glob("part-*.parquet")):
            data = path.read_bytes()
            if path.name != _PART.format(expected, _checksum(data)):
                due = f"the part that begins with run {expected}, and BLAKE2b {_checksum(data)} in its name"
                raise BadInput(str(path), "", path.name, due, "it is damaged, or one before it is missing")
            part = pq.read_table(pa.BufferReader(data), schema=self.schema)
            expected += part.num_rows
            parts.append(part)
        return pa.concat_tables(parts) if parts else self.schema.empty_table()


def _checksum(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=8).hexdigest()


def schema_of(plan: CampaignPlan) -> pa.Schema:
    """Columns with units and meanings, and in the metadata what the campaign is."""
    fields = [_field("run", pa.int64(), "", "number of the run, from 0")]
    fields += [_field(name, pa.int64(), "", text) for name, text in _COUNTS.items()]
    for name, value in plan.run(0).labels.items():
        kind = pa.string() if isinstance(value, str) else pa.float64()
        fields.append(
            _field(name, kind, name.rpartition("_")[2] if kind == pa.float64() else "", "it varies")
        )
    fields += [_field(name, kind, "", text) for name, (kind, text) in _TOLD.items()]
    fields += [_field(name, pa.float64(), each.unit, each.meaning) for name, each in FIGURES.items()]
    if plan.own.checks:
        fields.append(_field("findings", pa.list_(pa.string()), "", "what the check of one's own says of it"))
    metadata = {
        "format": FORMAT,
        "campaign": plan.sweep.campaign.name,
        "identity": plan.identity,
        "sweep": json.dumps(plan.sweep.model_dump(mode="json", by_alias=True)),
        "bench": plan.bench.config.resolved_text(),
        "servobench": version("servobench"),
    }
    return pa.schema(fields, metadata=metadata)


_COUNTS: Final = {
    "point": "number of the point of the grid, from 0",
    "replicate": "which draw and seed of the point, from 0",
    "seed": "bench.seed",
}
_TOLD: Final = {
    "weight": (pa.float64(), "of its draw: by how much the sweep's distributions have it more often"),
    "counts": (pa.bool_(), "whether it counts for the rate; not while adaptive draws are learning"),
    "outcome": (pa.string(), "what it came to, docs/verdict.md"),
    "passed": (pa.bool_(), "whether all that was asked was kept in a valid run"),
    "completed": (pa.bool_(), "whether all planned cycles were run"),
    "reason": (pa.string(), "the findings of the outcome, in words"),
    "certificate": (pa.string(), "what it says of the certificate, docs/verdict.md; empty: there is none"),
    "premises_left": (pa.string(), "what the certificate presumes and was not so"),
    "premises_unknown": (pa.string(), "what the certificate presumes and nobody knows"),
    "digest": (pa.string(), "BLAKE2b over the rows of its cycles, docs/recording.md"),
}


def _field(name: str, kind: Any, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"meaning": meaning, **({"unit": unit} if unit else {})})


def open_campaign(folder: Path, plan: CampaignPlan, resume: bool) -> RunStore:
    """The store of a campaign in ``folder``: a new one, or that of the same sweep to go on with.

    Raises BadInput: there is another campaign in it, or the same one and it is not to be resumed; or the
    guide of its draws is no figure.
    """
    adaptive = plan.sweep.adaptive
    if adaptive is not None and adaptive.guide not in FIGURES:
        raise BadInput(str(plan.source), "adaptive.guide", adaptive.guide, f"one of {', '.join(FIGURES)}")
    place = folder / PLAN_FILE
    identity = {"sweep": str(plan.source.absolute()), "identity": plan.identity}
    if place.exists():
        sweep, stored = _stored(place)
        if stored != plan.identity:
            expected = "a folder of its own, or the sweep and the files it names as they were"
            held = f"it holds the campaign of {sweep}"
            raise BadInput("--out", "", str(folder), expected, held)
        if not resume:
            raise BadInput("--out", "", str(folder), "a new or empty folder", "--resume goes on with it")
    else:
        folder.mkdir(parents=True, exist_ok=True)
        if any(each.suffix != _SUFFIX for each in folder.iterdir()):
            raise BadInput("--out", "", str(folder), "a new or empty folder, or that of a campaign")
        beside = place.with_suffix(_SUFFIX)
        beside.write_text(json.dumps(identity), encoding="utf-8")
        beside.rename(place)
    return RunStore(folder, schema_of(plan))


def plan_in(folder: Path) -> CampaignPlan:
    """Of the campaign in ``folder``. Raises BadInput: there is none, or its sweep has changed since."""
    place = folder / PLAN_FILE
    if not place.exists():
        raise BadInput("DIR", "", str(folder), "the folder of a campaign: --out of hil campaign")
    sweep, stored = _stored(place)
    plan = CampaignPlan.load(Path(sweep))
    if plan.identity != stored:
        expected = "the sweep and the files that it names as they were when the campaign ran"
        raise BadInput(sweep, "", plan.identity, expected)
    return plan


def _stored(place: Path) -> tuple[str, str]:
    """Path of the sweep, and the identity of its campaign. Raises BadInput."""
    table = parse_json(read_text(place, "campaign"), str(place), "what hil campaign wrote")
    match table:
        case {"sweep": str(sweep), "identity": str(identity)}:
            return sweep, identity
    raise BadInput(str(place), "", table, "the sweep and the identity of a campaign")
