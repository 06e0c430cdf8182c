"""``[twin]`` of a motor file: what ``hil fit`` found from recordings, how well, and where it holds."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from servobench.hil.configuration.config_files import Section

Range = Annotated[tuple[float, float], Field(strict=False)]
_ROUNDING = 1e-9
"""What digits written into a file leave of a covariance's symmetry."""


class TwinKeyTable(Section):
    """``[[twin.key]]``: a key that was looked for."""

    name: str = Field(min_length=1, description="the key, of this file or of its table [twin]")
    value: float = Field(description="in the key's own unit")
    uncertainty: float | None = Field(
        default=None, ge=0.0, description="expanded, k = 2; absent: not determined by these recordings"
    )
    source: Literal["fitted", "not determined", "fixed"] = Field(
        description="'fitted', or the value of the start: 'not determined' or 'fixed'"
    )


class TwinRecording(Section):
    """``[[twin.recording]]``: what it rests on."""

    digest: str = Field(min_length=1, description="digest of the recording's rows, as in its summary.json")
    bench: str = Field(description="name of the bench")
    windows: int = Field(ge=0, description="windows that were fitted")
    left_out: int = Field(ge=0, description="windows in doubt, with losses or a load")
    held_out: bool = Field(default=False, description="true: not fitted, only predicted")


class TwinTable(Section):
    """``[twin]``: nothing of it acts in a run; it says what the other tables are worth."""

    structure: Literal["rigid"] = Field(description="of what was fitted")
    dead_time_us: float = Field(ge=-1e5, le=1e5, description="from a command's arrival to its tick, us")
    speed_filter_hz: float = Field(gt=0.0, le=1e6, description="corner of the filter behind 606Ch, Hz")
    torque_unit_nm: float = Field(description="one unit of the set-points as the drive tells it, N m")
    window_s: float = Field(gt=0.0, description="length of a window, s")
    speed_rpm: Range = Field(description="range of validity, r/min")
    torque_nm: Range = Field(description="range of validity, N m")
    band_hz: Range = Field(description="band of the excitation, Hz")
    left: Annotated[tuple[float, float, float], Field(strict=False)] = Field(
        description="what was left of speed, rad/s, position, rad, and torque, N m, at most: rms of a window"
    )
    left_bands: Annotated[tuple[float, ...], Field(strict=False)] = Field(
        description="rms of what was left of the speed, rad/s, by octaves from one over window_s"
    )
    held_out_ratio: float | None = Field(
        default=None, ge=0.0, description="error on windows that were not fitted over that on those fitted"
    )
    key: Annotated[tuple[TwinKeyTable, ...], Field(strict=False)]
    covariance: Annotated[tuple[Annotated[tuple[float, ...], Field(strict=False)], ...], Field(strict=False)]
    """Of the fitted keys, in their order and units; standard, not expanded."""
    recording: Annotated[tuple[TwinRecording, ...], Field(strict=False, min_length=1)]

    @model_validator(mode="after")
    def _check_covariance(self) -> Self:
        fitted = [each for each in self.key if each.source == "fitted"]
        rows = self.covariance
        if len(rows) != len(fitted) or any(len(row) != len(fitted) for row in rows):
            raise ValueError(f"covariance of {len(fitted)} rows of {len(fitted)}, one for each fitted key")
        for place, row in enumerate(rows):
            for other, value in enumerate(row):
                scale = math.sqrt(abs(rows[place][place] * rows[other][other]))
                if abs(value - rows[other][place]) > _ROUNDING * scale:
                    raise ValueError("covariance that is symmetric")
        return self
