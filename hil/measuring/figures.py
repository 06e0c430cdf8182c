"""Results of a measurement: figures for programs, a network file, and a fault plan with the same effect on a
simulated bus."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from servobench.design.confidence import CONFIDENCE, rank_above, share_within_largest
from servobench.drivers.canopen.pdo import PdoMap
from servobench.drivers.timebase import NS_PER_US
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.network_file import Certainty, ClockHealth, LossChain, Network
from servobench.hil.execution.assembly import shortest_transit
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.cycle_record import COMMAND_FATES, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.measuring.loss_model import UNKNOWN, Losses, Outcomes, losses_of
from servobench.hil.measuring.stages import Stage
from servobench.hil.measuring.stamp_probe import StampFigures
from servobench.hil.measuring.subject import MeasureRequest
from servobench.hil.reviewing.histogram import TimeHistogram
from servobench.hil.reviewing.network_meter import NetworkMeter, delays_of, histogram_of
from servobench.hil.rows.records import Rows

Json = dict[str, Any]
_APART: Final = 1000
"""Unknown fates between the sequences of two drives, so that neither's state affects the other's."""
_ACTING: Final = COMMAND_FATES.index(CommandFate.ACTING)


@dataclass(frozen=True, slots=True)
class ClockFigures:
    """A drive's clock against the host's, by the map at the end."""

    drift_ppm: float
    drift_error_ppm: float
    offset_us: float
    """Host minus drive, at the last stamp."""
    error_us: float
    steps: int
    """Number of times it was found to be set."""

    @staticmethod
    def of(axis: Axis) -> "ClockFigures | None":
        """Return the figures; None for a drive without a clock."""
        by_stamp = axis.by_stamp
        clock = by_stamp.clock
        if not clock.ready:
            return None
        return ClockFigures(
            clock.drift_ppm,
            clock.drift_error_ppm,
            clock.offset_ns / NS_PER_US,
            clock.error_ns / NS_PER_US,
            by_stamp.health.steps,
        )


@dataclass(frozen=True, slots=True)
class MeasuredDrive:
    """One drive."""

    node: int
    identity: str
    speed: PdoMap
    """The TPDO that carries it."""
    command: PdoMap
    """The RPDO that carries the torque."""
    stages: Sequence[Stage]
    losses: dict[str, Losses]
    """By the keys of :func:`servobench.hil.measuring.stages.ways`."""
    uncertain: int
    """Readings for which the SYNC they answer is undecided."""
    clock: ClockFigures | None
    notes: Sequence[str]
    stamp: StampFigures | None = None
    """None: the drive has no such object."""
    readbacks_unordered: int = 0
    """Demands that came while the order of frames was unreliable."""


@dataclass(frozen=True, slots=True)
class Measured:
    """All results."""

    request: MeasureRequest
    cycles: int
    missed: int
    """Cycles without SYNC: the host came too late, or the last SYNC was not on the bus yet."""
    interrupted: bool
    echoes: EchoBasis
    host: Sequence[Stage]
    drives: Sequence[MeasuredDrive]
    network: Network | None
    """None if no reading came."""
    timing: Json
    """Basis of the readings' placement, as in a run's summary."""
    surplus: int
    """SYNCs that reached the bus after they had been given up: that many of those lost before it were
    late."""
    distrust: Sequence[str]
    """Reasons for distrust."""
    disturbances: Sequence[str] = ()
    """Forbidden frames from others on the bus: first frame, its time, count."""

    def as_json(self) -> Json:
        """Return the results for ``--json``."""
        request = self.request
        return {
            "bus": request.bus,
            "period_us": request.period_us,
            "cycles": self.cycles,
            "missed": self.missed,
            "enabled": request.enable,
            "interrupted": self.interrupted,
            "echoes": self.echoes.value,
            "confidence": CONFIDENCE,
            "host": {each.key: stage_json(each) for each in self.host},
            "drives": [_drive_json(drive) for drive in self.drives],
            "network": self.network and self.network.model_dump(mode="json", exclude_none=True),
            "timing": self.timing,
            "distrust": list(self.distrust),
            "disturbed": list(self.disturbances),
        }


def stage_json(measured: Stage) -> Json:
    """Return a stage: us, with bounds at the confidence of :mod:`servobench.design.confidence`."""
    times = measured.times
    delays, bars = delays_of(times), histogram_of(times)
    if delays is None or bars is None:
        return {"measured": False, "why": measured.basis}
    return {
        "measured": True,
        "basis": measured.basis,
        "samples": times.total,
        "p50_us": delays.p50,
        "p99_us": delays.p99,
        "p999_us": delays.p999,
        "max_us": delays.max,
        "p99_below_us": quantile_below_us(measured, 0.99),
        "p999_below_us": quantile_below_us(measured, 0.999),
        "share_within_max": share_within_largest(times.total),
        "histogram": bars.model_dump(mode="json"),
    }


def quantile_below_us(measured: Stage, share: float) -> float | None:
    """Return an upper bound of the true quantile, us; None if there are too few samples."""
    total = measured.times.total
    rank = rank_above(share, total)
    value = None if rank is None else measured.times.quantile_ns(rank / total)
    return None if value is None else value / NS_PER_US


def losses_json(losses: Losses) -> Json:
    """Return the losses on a path."""
    if losses.interval is None:
        return {"measured": False, "why": losses.why_none}
    figures: Json = {
        "measured": True,
        "known": losses.known,
        "lost": losses.lost,
        "runs": list(losses.runs),
        "percent": 100.0 * losses.lost / losses.known,
        "percent_interval": [100.0 * end for end in losses.interval],
    }
    if losses.model is None:
        return figures | {"model": None, "why": losses.why_none}
    model = losses.model
    return figures | {
        "model": {
            "kind": "independent" if model.independent else "gilbert_elliott",
            "method": "maximum likelihood",
            **model.parameters._asdict(),
            "intervals": {name: list(interval) for name, interval in model.intervals.items()},
        }
    }


def _drive_json(drive: MeasuredDrive) -> Json:
    clock = drive.clock
    return {
        "node": drive.node,
        "identity": drive.identity,
        "stages": {each.key: stage_json(each) for each in drive.stages},
        "losses": {way: losses_json(losses) for way, losses in drive.losses.items()},
        "uncertain": drive.uncertain,
        "clock": None if clock is None else asdict(clock),
        "stamp": None if drive.stamp is None else asdict(drive.stamp),
        "notes": list(drive.notes),
    }


def clocks_by_node(drives: Sequence[MeasuredDrive]) -> dict[str, ClockHealth]:
    """Return the clock of each drive: ``node1`` and so on."""
    return {f"node{drive.node}": _clock_of(drive) for drive in drives}


def _clock_of(drive: MeasuredDrive) -> ClockHealth:
    unordered = drive.readbacks_unordered
    clock, resolution_us = drive.clock, None if drive.stamp is None else drive.stamp.resolution_us
    if resolution_us is not None and not 0.01 <= resolution_us <= 1000.0:
        resolution_us = None  # such a stamp places no readings, and no bench takes the figure
    if clock is None:
        return ClockHealth(stamp_resolution_us=resolution_us, readbacks_unordered=unordered)
    return ClockHealth(
        drift_ppm=clock.drift_ppm,
        drift_error_ppm=clock.drift_error_ppm,
        error_us=clock.error_us,
        steps=clock.steps,
        stamp_resolution_us=resolution_us,
        readbacks_unordered=unordered,
    )


def network_of(period_us: int, rows: Sequence[Rows], ways: Sequence[dict[str, Outcomes]]) -> Network | None:
    """Return the network file of a measurement: all drives together. ``rows``, ``ways``: of each; None
    without a reading."""
    meter = NetworkMeter(period_us, len(rows))
    for each in rows:
        meter.add(each)
    network = meter.network()
    if network is None:
        return None
    readings, commands = (losses_of(_joined(ways, key)) for key in ("readings", "commands"))
    assert readings.interval is not None
    came = sum(int((each["delay_ns"] != NOTHING).sum()) for each in rows)
    acting = [each[each["command_fate"] == _ACTING] for each in rows]
    acted = sum(each.size for each in acting)
    effect = TimeHistogram()
    for each in acting:
        effect.add(each["command_acts_by"] - each["command_handed_at"])
    certainty = Certainty(
        confidence=CONFIDENCE,
        loss_percent=_percent(readings) or (0.0, 100.0),
        command_loss_percent=_percent(commands),
        reading_delay_share=share_within_largest(came),
        action_delay_share=share_within_largest(acted) if acted else None,
    )
    return network.model_copy(
        update={
            "command_histogram": histogram_of(effect),
            "reading_losses": _chain_of(readings),
            "command_losses": _chain_of(commands),
            "certainty": certainty,
        }
    )


def _chain_of(losses: Losses) -> LossChain | None:
    """Return the model of these losses; None if there is none."""
    model = losses.model
    return None if model is None else LossChain(**model.parameters._asdict())


def fault_plan_text(measured: Measured) -> str:
    """Return a fault plan by which a simulated bus treats these drives like the measured one.

    Losses affect the measured frames: SYNC, those with the speed, the commands. The time of a frame on an
    idle bus is left out of the delays, since the simulated bus adds it again.
    """
    request = measured.request
    head = (
        f"# What {request.bus} did in {measured.cycles} cycles of {request.period_us} us.\n"
        "# Losses that were too few to be modelled are not in it.\n\n"
    )
    tables: dict[str, list[Json]] = {"measured_delay": [], "burst": []}
    for drive in measured.drives:
        tables["measured_delay"] += _delays(drive, request.bitrate_bit_s)
        tables["burst"] += _bursts(drive)
    sync = measured.drives[0].losses["sync_before_bus"]
    tables["burst"] += _burst(sync, {"side": "host", "direction": "host_to_drive", "frames": ["sync"]})
    return head + toml_text({name: entries for name, entries in tables.items() if entries})


def _delays(drive: MeasuredDrive, bitrate: int) -> Iterator[Json]:
    stages = {each.key: each.times for each in drive.stages}
    reading, command = (shortest_transit(pdo.bits // 8, bitrate) for pdo in (drive.speed, drive.command))
    for key, transit, where in (
        ("reception", reading, _from_drive(drive, "pdo")),
        ("command_on_bus", command, _command(drive, "host")),
        ("command_acting", 0, _command(drive, "drive")),
    ):
        bars = histogram_of(stages[key])
        if bars is None:
            continue
        # Whole bars go down together, so that none of them changes its width; the first may lose a part.
        edges = np.maximum(np.array(bars.edges_us) - transit / NS_PER_US, 0.0)
        counts = np.array(bars.counts)
        kept = edges[1:] > edges[:-1]
        if kept.any():
            first = int(np.flatnonzero(kept)[0])
            counts[first] += counts[:first].sum()
            yield {**where, "edges_us": edges[first:].tolist(), "counts": counts[first:].tolist()}


def _bursts(drive: MeasuredDrive) -> Iterator[Json]:
    for key, where in (
        ("reading", _from_drive(drive, drive.speed.cob_id)),
        ("command_before_bus", _command(drive, "host")),
        ("command_behind_bus", _command(drive, "drive")),
    ):
        yield from _burst(drive.losses[key], where)


def _burst(losses: Losses, where: Json) -> Iterator[Json]:
    if losses.model is not None:
        yield {**where, **losses.model.parameters._asdict()}


def _from_drive(drive: MeasuredDrive, frames: int | str) -> Json:
    """Return a selector for all frames that travel with the speed: they share its delay, as an overtaking
    frame would belong to another SYNC."""
    return {"side": "drive", "nodes": [drive.node], "direction": "drive_to_host", "frames": [frames]}


def _command(drive: MeasuredDrive, side: str) -> Json:
    where: Json = {"side": side, "direction": "host_to_drive", "frames": [drive.command.cob_id]}
    return where if side == "host" else {**where, "nodes": [drive.node]}


def _percent(losses: Losses) -> tuple[float, float] | None:
    if losses.interval is None:
        return None
    return 100.0 * losses.interval.low, 100.0 * losses.interval.high


def _joined(ways: Sequence[dict[str, Outcomes]], key: str) -> Outcomes:
    gap = np.full(_APART, UNKNOWN, np.int8)
    parts = [part for each in ways for part in (gap, each[key])]
    return np.concatenate(parts[1:])
