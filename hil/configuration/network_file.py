"""Network files: delays and losses of readings and commands, measured by a command or written by hand.

``hil run`` leaves one, ``network.toml``, in its folder, ``hil measure`` writes one with confidence limits;
``hil design speed --network`` designs for it, and ``hil run --network`` compares a controller's own with it
before anything moves.
"""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import Section, toml_text, validated

NETWORK_FILE = "network.toml"


class DelayFigures(Section):
    """A distribution of delays, us."""

    p50: float = Field(ge=0)
    p99: float = Field(ge=0)
    p999: float = Field(ge=0)
    max: float = Field(ge=0)


class DelayHistogram(Section):
    """``histogram``: in the form of a fault plan's [[measured_delay]], so that the network can be
    replayed."""

    edges_us: Annotated[tuple[float, ...], Field(strict=False, min_length=2)]
    counts: Annotated[tuple[int, ...], Field(strict=False, min_length=1)]


class LossChain(Section):
    """Losses in the form of a fault plan's [[burst]]; independent ones have ``loss_good`` alone."""

    p_good_to_bad: float = Field(ge=0, le=1)
    p_bad_to_good: float = Field(ge=0, le=1)
    loss_bad: float = Field(ge=0, le=1)
    loss_good: float = Field(ge=0, le=1)


Percent = Annotated[float, Field(ge=0, le=100)]


class Certainty(Section):
    """``[network.certainty]``: confidence of the figures from a sample, at ``confidence``."""

    confidence: float = Field(gt=0, lt=1)
    loss_percent: Annotated[tuple[Percent, Percent], Field(strict=False)]
    """Interval of the true share of lost readings."""
    command_loss_percent: Annotated[tuple[Percent, Percent], Field(strict=False)] | None = None
    reading_delay_share: float = Field(ge=0, le=1)
    """Share of all readings, future ones included, that are delayed by no more than the largest delay
    seen."""
    action_delay_share: float | None = Field(default=None, ge=0, le=1)
    """The same from sample to actuation."""


class ClockHealth(Section):
    """``clocks.AXIS``: a drive's clock, and the basis of its readings' placement."""

    drift_ppm: float | None = None
    """How much faster it runs than the host's; None for a drive without stamps."""
    drift_error_ppm: float | None = Field(default=None, ge=0)
    """Two standard deviations of it."""
    error_us: float = Field(default=0.0, ge=0)
    """The largest error bound of a certain sampling instant."""
    steps: int = Field(default=0, ge=0)
    """Number of times it was set."""
    stamp_resolution_us: float | None = Field(default=None, ge=0.01, le=1000)
    """Step of its stamp, if measured."""
    readbacks_unordered: int = Field(default=0, ge=0)
    """Demands that came while the order of frames was unreliable: they did not count commands lost behind
    their echo."""


class Network(Section):
    """``[network]``: a design needs the first three keys, the others are evidence."""

    period_us: int = Field(gt=0, le=1_000_000, description="the sampling period, us")
    losses_in_a_row_max: int = Field(ge=0, le=1000, description="most readings missing in a row")
    delay_max_us: int = Field(ge=0, description="largest delay from sample to actuator, us")
    command_losses_in_a_row_max: int = Field(default=0, ge=0, le=1000)
    """Most commands lost or passed over in a row: upper limit of the losses."""
    commands: Literal["stated", "measured", "not measured"] = "stated"
    """Source of the commands' figures: stated by the file's author, reported by the drive (6074h), or none;
    without one nothing can be certified on it."""
    cycles: int = Field(default=0, ge=0)
    """Readings requested; all axes together."""
    lost: int = Field(default=0, ge=0)
    late: int = Field(default=0, ge=0)
    stale: int = Field(default=0, ge=0)
    missed: int = Field(default=0, ge=0)
    """Cycles without SYNC: losses caused by the host."""
    uncertain_percent: float = Field(default=0.0, ge=0, le=100)
    """Cycles for which the data do not decide whose reading it was, or that it was lost."""
    loss_percent: float = Field(default=0.0, ge=0, le=100)
    losses_in_a_row: Annotated[tuple[int, ...], Field(strict=False)] = ()
    """How often exactly 1, 2, ... readings were missing in a row."""
    reading_delay_us: DelayFigures | None = None
    """From sample to host, of every reading received."""
    action_delay_us: DelayFigures | None = None
    """From sample to the first actuation that can depend on it: upper limit."""
    action_delay_least_us: DelayFigures | None = None
    """Lower limit of the same."""
    command_delay_us: DelayFigures | None = None
    """From handing a command over to its end on the bus, by its echo."""
    commands_acting: int = Field(default=0, ge=0)
    """Commands that the drive was seen to follow."""
    commands_lost: int = Field(default=0, ge=0)
    """Commands that it cannot have followed at any instant."""
    commands_not_sent: int = Field(default=0, ge=0)
    """Those among them for which the adapter had no room before the next one."""
    commands_not_identifiable: int = Field(default=0, ge=0)
    """Commands for which neither is known: they equal a neighbour, or were not checked in time."""
    commands_passed_over: int = Field(default=0, ge=0)
    """Those among them that had arrived before a SYNC, were not followed then, and were replaced: lost, or
    followed between two SYNCs only."""
    command_loss_percent: float | None = Field(default=None, ge=0, le=100)
    """Lost or passed over, of those and the ones acting: upper limit of the losses."""
    command_loss_least_percent: float | None = Field(default=None, ge=0, le=100)
    """Lost, of the same."""
    histogram: DelayHistogram | None = None
    """Histogram of the readings' delay."""
    command_histogram: DelayHistogram | None = None
    """Histogram of the commands' delay, from handing over to the effect on the drive."""
    reading_losses: LossChain | None = None
    """None: not identifiable."""
    command_losses: LossChain | None = None
    certainty: Certainty | None = None
    clocks: dict[str, ClockHealth] = Field(default_factory=dict)
    """By axis; in a measurement by node."""

    @property
    def losses_max(self) -> int:
        """D of [Ling2012] (2.13): losses in a row on both ways together, their (2.11)."""
        return self.losses_in_a_row_max + self.command_losses_in_a_row_max

    @property
    def period_s(self) -> float:
        """h, s."""
        return self.period_us * 1e-6

    @property
    def delay_max_s(self) -> float:
        """T, s."""
        return self.delay_max_us * 1e-6

    @property
    def age_max_s(self) -> float:
        """Longest time for which a sample acts, [Ling2012] (2.13): (D + 1) h + T, s."""
        return (self.losses_max + 1) * self.period_s + self.delay_max_s


class NetworkFile(Section):
    """A whole file."""

    network: Network = Field(description="the table [network]")


def load_network(path: Path) -> Network:
    """Load the network in the file at ``path``. Raises BadInput or BadInputs."""
    tables = read_toml(path, "network file", NamedBy("--network", "", str(path)))
    if "network" not in tables and "bench" in tables:
        raise BadInput(
            "--network",
            "",
            f"{path}, a bench file",
            "a network file, such as network.toml in a run's recording",
            f"hil run {path} --record DIR makes one",
        )
    network = validated(NetworkFile, tables, str(path)).network
    histograms = {"histogram": network.histogram, "command_histogram": network.command_histogram}
    for name, each in histograms.items():
        if each is not None and len(each.edges_us) != len(each.counts) + 1:
            expected = f"one more than the {len(each.counts)} counts"
            raise BadInput(str(path), f"network.{name}.edges_us", f"{len(each.edges_us)} edges", expected)
    return network


def stamp_resolutions_us(path: Path) -> dict[str, float]:
    """Return the stamps' steps, for the clocks in the network file at ``path`` that have one.

    Raises BadInput or BadInputs.
    """
    clocks = load_network(path).clocks
    return {
        name: clock.stamp_resolution_us
        for name, clock in clocks.items()
        if clock.stamp_resolution_us is not None
    }


def commands_unknown(network: Network, source: str) -> BadInput | None:
    """Explain why nothing can be certified on ``network``, the one of ``source``; None if something can."""
    if network.commands != "not measured":
        return None
    return BadInput(
        source,
        "network.commands",
        network.commands,
        "measured or stated: losses and delays of the commands are part of the loop",
        "measure with a drive that tells 6074h, or state command_losses_in_a_row_max and a delay_max_us that "
        'holds to the actuator, with commands = "stated"',
    )


def losses_unseen(network: Network, source: str) -> str:
    """Explain why more commands may have been lost on ``network`` than its file counts; empty if there is no
    sign."""
    axes = [name for name, clock in network.clocks.items() if clock.readbacks_unordered]
    if not axes:
        return ""
    told = ", ".join(f"{network.clocks[name].readbacks_unordered} of {name}" for name in axes)
    return (
        f"{source}: read-backs came while frames overtook one another or came twice ({told}): commands lost "
        "behind their echo were not counted then, and the design may be for too few; find what doubles or "
        "reorders frames, and measure again"
    )


def network_text(network: Network) -> str:
    """Return the file text of ``network``."""
    return toml_text({"network": network.model_dump(mode="json", exclude_none=True)})
