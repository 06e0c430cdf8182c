"""What a measurement found, and how it is told to programs."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from drivers.timebase import NS_PER_US
from drivers.wire.frame_port import EchoBasis
from hil.configuration.network_file import Network
from hil.loop.axis import Axis
from hil.measuring.bounds import CONFIDENCE, rank_above, share_within_largest
from hil.measuring.loss_model import Losses
from hil.measuring.request import MeasureRequest
from hil.measuring.stages import Stage
from hil.reviewing.network_meter import delays_of, histogram_of

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class ClockFigures:
    """A drive's clock against the host's, by the map at the end."""

    drift_ppm: float
    drift_error_ppm: float
    offset_us: float
    """Host minus drive, at the last stamp."""
    error_us: float
    steps: int
    """Times that it was found to be set."""

    @staticmethod
    def of(axis: Axis) -> "ClockFigures | None":
        """None for a drive without a clock."""
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
    speed_cob_id: int
    """Of the TPDO that carries the speed."""
    speed_bytes: int
    command_cob_id: int
    """Of the RPDO that carries the torque."""
    command_bytes: int
    stages: Sequence[Stage]
    losses: dict[str, Losses]
    """By the keys of :func:`hil.measuring.stages.ways`."""
    uncertain: int
    """Readings of which it is not decided which SYNC they answer."""
    clock: ClockFigures | None
    notes: Sequence[str]


@dataclass(frozen=True, slots=True)
class Measured:
    """Everything."""

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
    """As in the summary of a run: what placing the readings rests on."""
    surplus: int
    """SYNCs that came to the bus after they had been given up: as many of those lost before it were late."""
    distrust: Sequence[str]
    """Why what was measured is not to be trusted."""

    def as_json(self) -> Json:
        """For ``--json``."""
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
        }


def stage_json(measured: Stage) -> Json:
    """A stage: us, with bounds at the confidence of :mod:`hil.measuring.bounds`."""
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
    """What the true quantile does not exceed, us; None where the samples are too few to say."""
    total = measured.times.total
    rank = rank_above(share, total)
    value = None if rank is None else measured.times.quantile_ns(rank / total)
    return None if value is None else value / NS_PER_US


def losses_json(losses: Losses) -> Json:
    """Losses on a way."""
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
        "notes": list(drive.notes),
    }
