"""The table of a campaign on disk: a Parquet dataset that only grows, by whole files.

Each file holds the next runs in order of their number, is written beside its place, synced, and put there by
one rename: after any kill the files are whole, and continuous from run 0.

The seal has a line for each version of each file, chained as in a recording's, with its digest, which is
checked whenever the file is read. A file is written beside its place, its line into the seal, and then it is
put in its place: who dies in between leaves both, and who goes on puts it there. A campaign that is left in
order ends its seal.
"""

import fcntl
import json
import os
import platform
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Self

import pyarrow as pa
import pyarrow.parquet as pq

from servobench.drivers.bounded_file import parse_json, read_text
from servobench.drivers.errors import BadInput
from servobench.drivers.written_file import is_locked, sync_folder, write_synced, writing
from servobench.hil.campaign.identity import Identity, require_program
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.worker import FIGURES, Row
from servobench.hil.recording.append_file import AppendFile
from servobench.hil.rows.run_files import SEAL_FILE
from servobench.hil.rows.seal import ENDED, FIRST_CHAIN, Piece, digest_of, read_seal, sealed_line

SUFFIX: Final = ".writing"
_RESTORE: Final = "restore it, or begin a campaign in a folder of its own with --out"
_GOES_ON: Final = "--resume goes on with it"


class StoreSeal:
    """Writes the files of a store; its folder is locked meanwhile."""

    def __init__(self, folder: Path, *, fresh: bool) -> None:
        """``fresh``: a new store. Raises BadInput for a damaged seal."""
        self._folder = folder
        self._chain, self._ended = FIRST_CHAIN, False
        self.cut_short = ""
        """How the seal ended if no campaign had ended it; empty: it was left in order."""
        if not fresh:
            _require_seal(folder)
        size = 0 if fresh else (folder / SEAL_FILE).stat().st_size
        self._file = AppendFile(folder / SEAL_FILE, fresh=fresh)
        last = None
        for last, chain in () if fresh else read_seal(folder, _RESTORE):
            self._chain, self._ended = chain, last == ENDED
        if not fresh and not self._ended:
            whole = size == (folder / SEAL_FILE).stat().st_size
            self.cut_short = "no last line" if whole else "an incomplete last line"
        if isinstance(last, Piece):
            beside = (folder / last.file).with_suffix(SUFFIX)
            if beside.is_file() and _digest(beside) == last.digest:
                self._put_in_place(beside, last.file)

    def put(self, name: str, data: bytes) -> None:
        """Write a file, or its next version. Error: OSError."""
        beside = (self._folder / name).with_suffix(SUFFIX)
        with beside.open("wb") as file:
            write_synced(file, data)
        self._write({"file": name, "begin": 0, "end": len(data), "digest": _digest(beside)})
        self._put_in_place(beside, name)
        self._ended = False

    def close(self) -> None:
        """End the seal: everything is written. Error: OSError."""
        if not self._ended:
            self._write({ENDED: True})
        self._file.close()

    def _put_in_place(self, beside: Path, name: str) -> None:
        place = self._folder / name
        beside.rename(place)
        sync_folder(place.parent)

    def _write(self, plain: dict[str, Any]) -> None:
        line, self._chain = sealed_line(plain, self._chain)
        self._file.write(line.encode())
        self._file.sync()


def sealed_files(folder: Path, *, under_way: bool, among: str) -> Iterator[Path]:
    """Yield the files of a store in order of their first lines, each checked against its seal.

    ``under_way``: somebody writes to it, whose last file may not be in its place yet. ``among``: a pattern of
    names, of which none else may be there. Raises BadInput.
    """
    _require_seal(folder)
    versions: dict[str, list[str]] = {}
    last: Piece | str = ""
    for last, _ in read_seal(folder, _RESTORE, _GOES_ON):
        if isinstance(last, Piece):
            versions.setdefault(last.file, []).append(last.digest)
    if last != ENDED and not under_way:
        expected = "the end of a campaign that was left in order"
        raise BadInput(str(folder / SEAL_FILE), "", "no last line", expected, _GOES_ON)
    waiting = last.file if isinstance(last, Piece) and under_way else ""
    for path in sorted(folder.glob(among)):
        if str(path.relative_to(folder)) not in versions:
            raise BadInput(str(path), "", "a file", f"none: no line of {SEAL_FILE} has it", _RESTORE)
    for name, digests in versions.items():
        path = folder / name
        now = _digest(path) if path.is_file() else "no file"
        if now == digests[-1]:
            yield path
        elif name == waiting and now == ("no file" if len(digests) == 1 else digests[-2]):
            if len(digests) > 1:
                yield path
        else:
            raise BadInput(str(path), "", f"BLAKE2b {now}", f"{digests[-1]}, as it was written", _RESTORE)


def _require_seal(folder: Path) -> None:
    if not (folder / SEAL_FILE).is_file():
        expected = "a campaign with its seal: an older version had none"
        raise BadInput(str(folder / SEAL_FILE), "", "no file", expected, _RESTORE)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return digest_of(file, 0, os.fstat(file.fileno()).st_size)


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
        """Sign that the campaign resumed was not left in order; empty: it was."""
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
    fields += [_field(name, pa.float64(), each.unit, each.title) for name, each in FIGURES.items()]
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
    "outcome": (pa.string(), "what it came to, hil docs exit-status"),
    "passed": (pa.bool_(), "whether all that was asked was kept in a valid run"),
    "completed": (pa.bool_(), "whether all planned cycles were run"),
    "reason": (pa.string(), "the findings of the outcome, in words"),
    "certificate": (pa.string(), "what it says of the certificate, hil docs verdict; empty: there is none"),
    "premises_left": (pa.string(), "what the certificate presumes and was not so"),
    "premises_unknown": (pa.string(), "what the certificate presumes and nobody knows"),
    "digest": (pa.string(), "BLAKE2b over the rows of its cycles, hil docs recording"),
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
