"""The table of a campaign on disk: a Parquet dataset that only grows, by whole files.

Each file holds the next runs in order of their number, is written beside its place, synced, and put there by
one rename: after any kill the files are whole, and continuous from run 0. A seal has the digest of each
(:mod:`servobench.hil.campaign.store_seal`), which is checked whenever it is read.
"""

import fcntl
import json
import os
import platform
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.parquet as pq

from servobench.drivers.bounded_file import parse_json, read_text
from servobench.drivers.errors import BadInput
from servobench.drivers.written_file import writing
from servobench.hil.campaign.identity import Identity, require_program
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.store_seal import SUFFIX, StoreSeal, sealed_files
from servobench.hil.campaign.worker import FIGURES, Row
from servobench.hil.machine.on_disk import is_locked
from servobench.hil.rows.run_files import SEAL_FILE

FORMAT: Final = "3"
PLAN_FILE: Final = "campaign.json"
RUNS_FOLDER: Final = "runs"
LOCK_FILE: Final = "campaign.lock"
_HOLDER_BYTES: Final = 200
"""Size of the lock file: a process and the name of a host, 64 characters on Linux."""
_PART: Final = "part-{:09d}.parquet"
_PARTS: Final = f"{RUNS_FOLDER}/part-*.parquet"


class RunStore:
    """The store of one campaign, in its folder, which nobody else writes to meanwhile."""

    def __init__(self, folder: Path, plan: CampaignPlan, lock: int, seal: StoreSeal) -> None:
        """``folder``: that of the campaign, which exists; ``lock``: a descriptor to close with the store,
        like ``seal``. Raises BadInput for incomplete files."""
        self.folder, self._plan, self._lock, self._seal = folder, plan, lock, seal
        self.cut_short = (
            f"{folder / SEAL_FILE}: {seal.cut_short}, as a kill leaves it" if seal.cut_short else ""
        )
        """What shows that the campaign resumed was not left in order; empty: it was."""
        self._runs = folder / RUNS_FOLDER
        self.schema = schema_of(plan)
        self._runs.mkdir(exist_ok=True)
        for left in self._runs.glob(f"*{SUFFIX}"):
            left.unlink()
        self.count = self.table().num_rows
        """Stored runs: 0 to ``count`` - 1."""

    def close(self) -> None:
        """Release the folder for other writers; a second call does no harm."""
        lock, self._lock = self._lock, -1
        if lock >= 0:
            with suppress(OSError):  # the disk is full: --resume will end it
                self._seal.close()
            os.close(lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def append(self, rows: Sequence[Row]) -> None:
        """Store the next runs. Raises BadInput or DiskFull for a folder that cannot take them."""
        numbers = [row["run"] for row in rows]
        if numbers != list(range(self.count, self.count + len(rows))):
            raise ValueError(f"runs {numbers[:3]}..., expected those from {self.count} on")
        if not rows:
            return
        sink = pa.BufferOutputStream()
        pq.write_table(pa.Table.from_pylist(list(rows), schema=self.schema), sink, compression="zstd")
        with writing("--out", self.folder):
            if self._plan.files.fresh():  # before the rows that rest on them
                _write_plan(self._seal, self._plan)
            self._seal.put(f"{RUNS_FOLDER}/{_PART.format(self.count)}", sink.getvalue().to_pybytes())
        self.count += len(rows)

    def table(self) -> pa.Table:
        """Return the stored runs; see :func:`stored_runs`."""
        return stored_runs(self.folder, self.schema)


def stored_runs(folder: Path, schema: pa.Schema) -> pa.Table:
    """Return all runs in order of the campaign in ``folder``, even while it runs.

    Raises BadInput for a file that is damaged or missing, or not written by any of its runs.
    """
    parts = [pq.read_table(path, schema=schema) for path in _sealed(folder) if path.name != PLAN_FILE]
    return pa.concat_tables(parts) if parts else schema.empty_table()


def _sealed(folder: Path) -> list[Path]:
    return list(sealed_files(folder, under_way=is_locked(folder / LOCK_FILE), among=_PARTS))


def schema_of(plan: CampaignPlan) -> pa.Schema:
    """Return the columns with units and meanings, and in the metadata the campaign."""
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
    "outcome": (pa.string(), "what it came to, docs/exit-status.md"),
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
    """Open the store of a campaign in ``folder``: a new one, or that of the same sweep to resume.

    Raises BadInput: there is another campaign in it, or the same one and it is not to be resumed; one of its
    files, or the program, is not as it was; somebody writes to it; or the guide of its draws is no figure.
    Raises BadInput or DiskFull for a folder that cannot be written.
    """
    adaptive = plan.sweep.adaptive
    if adaptive is not None and adaptive.guide not in FIGURES:
        raise BadInput(str(plan.source), "adaptive.guide", adaptive.guide, f"one of {', '.join(FIGURES)}")
    with writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            _lock(folder, lock)
            return RunStore(folder, plan, lock, _begin(folder, plan, resume))
        except BaseException:
            os.close(lock)
            raise


def _lock(folder: Path, lock: int) -> None:
    """Lock the folder: the kernel holds the lock, so none survives its process; the file names the owner."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(lock, _HOLDER_BYTES, 0).decode(errors="replace").strip()
        expected = "a folder to which no other campaign is writing"
        raise BadInput("--out", "", str(folder), expected, f"{holder or 'another process'} does") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadInput("--out", "", str(folder), "a folder on a file system that has flock", reason) from None
    os.ftruncate(lock, 0)
    os.pwrite(lock, f"process {os.getpid()} on {platform.node()}\n".encode(), 0)


def _begin(folder: Path, plan: CampaignPlan, resume: bool) -> StoreSeal:
    place = folder / PLAN_FILE
    if not place.exists():
        others = (each.name for each in folder.iterdir() if each.suffix != SUFFIX)
        if not {LOCK_FILE, SEAL_FILE}.issuperset(others):
            raise BadInput("--out", "", str(folder), "a new or empty folder, or that of a campaign")
        seal = StoreSeal(folder, fresh=True)
        _write_plan(seal, plan)
        return seal
    seal = StoreSeal(folder, fresh=False)
    _sealed(folder)
    sweep, identity = _stored(place)
    if sweep.name != plan.source.name:
        expected = "a folder of its own, or the sweep of that campaign"
        raise BadInput("--out", "", str(folder), expected, f"it holds the campaign of {sweep}")
    plan.require(identity)
    if not resume:
        raise BadInput("--out", "", str(folder), "a new or empty folder", "--resume goes on with it")
    require_program(identity["program"], str(place))
    return seal


def _write_plan(seal: StoreSeal, plan: CampaignPlan) -> None:
    plan.files.fresh()
    told = {"sweep": str(plan.source), "identity": plan.identity}
    seal.put(PLAN_FILE, json.dumps(told, indent=1).encode())


def plan_in(folder: Path) -> CampaignPlan:
    """Load the plan of the campaign in ``folder``. Raises BadInput: there is none, or a file opened by its
    runs, the sweep included, has changed."""
    place = folder / PLAN_FILE
    if not place.exists():
        raise BadInput("DIR", "", str(folder), "the folder of a campaign: --out of hil campaign")
    _sealed(folder)
    sweep, identity = _stored(place)
    plan = CampaignPlan.load(sweep)
    plan.require(identity)
    return plan


def _stored(place: Path) -> tuple[Path, Identity]:
    """Return the path of the sweep, and the identity of its campaign. Raises BadInput."""
    table = parse_json(read_text(place, "campaign"), str(place), "what hil campaign wrote")
    match table:
        case {
            "sweep": str(sweep),
            "identity": {"sweep": str(), "program": dict() as program, "files": dict() as files} as identity,
        } if all(isinstance(value, str) for value in (*program.values(), *files.values())):
            return Path(sweep), identity
        case {"sweep": str(), "identity": str()}:
            expected = "a campaign of this version: the older one kept no account of files and program"
            raise BadInput(str(place), "identity", table["identity"], expected)
    raise BadInput(str(place), "", table, "the sweep and the identity of a campaign")
