"""Network files: what a network does to readings and commands, measured by ``hil run`` or written by hand.

A run leaves one, ``network.toml``, in its folder; ``hil design speed --network`` designs for it, and
``hil run --network`` holds a controller's own against it before anything moves.
"""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from drivers.bounded_file import NamedBy, read_toml
from drivers.errors import BadInput
from hil.configuration.config_errors import raise_all, translate
from hil.configuration.config_files import Section
from hil.configuration.toml_text import toml_text

NETWORK_FILE = "network.toml"


class Delays(Section):
    """A distribution of delays, us."""

    p50: float = Field(ge=0)
    p99: float = Field(ge=0)
    p999: float = Field(ge=0)
    max: float = Field(ge=0)


class DelayHistogram(Section):
    """``histogram``: as a fault plan's [[measured_delay]] takes it, so that the network can be replayed."""

    edges_us: Annotated[tuple[float, ...], Field(strict=False, min_length=2)]
    counts: Annotated[tuple[int, ...], Field(strict=False, min_length=1)]


class Network(Section):
    """``[network]``: the first three keys are what a design needs, the others are evidence."""

    period_us: int = Field(gt=0, le=1_000_000, description="the sampling period, us")
    losses_in_a_row_max: int = Field(ge=0, le=1000, description="most readings missing in a row")
    delay_max_us: int = Field(ge=0, description="largest delay from sample to actuator, us")
    command_losses_in_a_row_max: int = Field(default=0, ge=0, le=1000)
    """Most commands lost in a row."""
    commands: Literal["stated", "measured", "not measured"] = "stated"
    """How the way of the commands is known: stated by whoever wrote the file, told by the drive (6074h), or
    not at all; then nothing can be certified on it."""
    cycles: int = Field(default=0, ge=0)
    """Readings asked for; all axes together."""
    lost: int = Field(default=0, ge=0)
    late: int = Field(default=0, ge=0)
    stale: int = Field(default=0, ge=0)
    loss_percent: float = Field(default=0.0, ge=0, le=100)
    losses_in_a_row: Annotated[tuple[int, ...], Field(strict=False)] = ()
    """How often exactly 1, 2, ... readings were missing in a row."""
    reading_delay_us: Delays | None = None
    """From sample to host, of every reading that came."""
    action_delay_us: Delays | None = None
    """From sample to the actuation that can first rest on it: the most that it may be."""
    action_delay_least_us: Delays | None = None
    """The least that it may be."""
    command_delay_us: Delays | None = None
    """From handing a command over until its end on the bus, by its echo."""
    commands_acting: int = Field(default=0, ge=0)
    """Commands that the drive was seen to follow."""
    commands_lost: int = Field(default=0, ge=0)
    """Commands that it was seen not to follow."""
    commands_not_identifiable: int = Field(default=0, ge=0)
    """Commands that equal a neighbour: neither can be said."""
    command_loss_percent: float | None = Field(default=None, ge=0, le=100)
    """Of those of which it can be said."""
    histogram: DelayHistogram | None = None
    """Of the readings' delay."""

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


def load_network(path: Path, option: str = "--network") -> Network:
    """The network in the file at ``path``. Raises BadInput or BadInputs."""
    tables = read_toml(path, "network file", NamedBy(option, "", str(path)))
    if "network" not in tables and "bench" in tables:
        raise BadInput(
            option,
            "",
            f"{path}, a bench file",
            "a network file, as a run leaves it in its recording: network.toml",
            f"hil run {path} --record DIR makes one",
        )
    try:
        found = NetworkFile.model_validate(tables).network
    except ValidationError as error:
        raise_all(translate(error, str(path), tables, NetworkFile))
    if found.histogram and len(found.histogram.edges_us) != len(found.histogram.counts) + 1:
        raise BadInput(
            str(path),
            "network.histogram.edges_us",
            f"{len(found.histogram.edges_us)} edges",
            f"one more than the {len(found.histogram.counts)} counts",
        )
    return found


def commands_unknown(network: Network, source: str) -> BadInput | None:
    """Why nothing can be certified on ``network``, the one of ``source``; None if something can."""
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


def network_text(network: Network) -> str:
    """The file of ``network``."""
    return toml_text({"network": network.model_dump(mode="json", exclude_none=True)})
