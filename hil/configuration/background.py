"""``[[bus.background]]``: other nodes' frames on the bus, in a bench file or in a separate file."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.configuration.config_files import Section, load_file
from servobench.virtual_bus.device.background import Stream


class Background(Section):
    """The frames of one identifier."""

    can_id: int = Field(ge=0, lt=1 << 29, description="an identifier, e.g. 0x3A0")
    extended: bool = False
    """True: the identifier has 29 bits."""
    remote: bool = False
    bytes_max: int = Field(default=8, ge=0, le=8)
    bytes_min: int = Field(default_factory=lambda data: data.get("bytes_max", 8), ge=0, le=8)
    """Default: bytes_max."""
    period_us: int = Field(ge=1, le=3_600_000_000, description="from frame to frame, us")
    jitter_us: int = Field(default=0, ge=0)
    """Each frame comes up to this much later."""
    arrivals: Literal["periodic", "random"] = "periodic"
    """``random``: with the period as mean distance."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if not self.extended and self.can_id >= 1 << 11:
            raise ValueError("can_id: 11 bits, at most 0x7FF, or extended = true")
        if self.bytes_min > self.bytes_max:
            raise ValueError(f"bytes_min: at most bytes_max = {self.bytes_max}")
        if self.jitter_us > self.period_us:
            raise ValueError(f"jitter_us: at most period_us = {self.period_us}")
        if self.jitter_us and self.arrivals == "random":
            raise ValueError("jitter_us: none, as random arrivals have their own")
        return self

    @property
    def stream(self) -> Stream:
        """The stream for the simulated world."""
        return Stream(
            self.can_id,
            Duration(self.period_us * NS_PER_US),
            self.extended,
            self.remote,
            self.bytes_min,
            self.bytes_max,
            Duration(self.jitter_us * NS_PER_US),
            self.arrivals,
        )


BackgroundTables = Annotated[tuple[Background, ...], Field(strict=False)]


class BackgroundFile(Section):
    """A file of background traffic."""

    background: Annotated[tuple[Background, ...], Field(strict=False, min_length=1)] = Field(
        description="at least one table [[background]]"
    )


def load_background(path: Path, named_by: NamedBy | None = None) -> tuple[Stream, ...]:
    """Load the streams of the file at ``path``. Raises BadInput or BadInputs."""
    file = load_file(BackgroundFile, path, "file of background traffic", named_by)
    return tuple(entry.stream for entry in file.background)
