"""A fit as a motor file with its table ``[twin]``, as JSON and as lines of text."""

import math
from typing import Any, Final

import numpy as np

from servobench.drivers.rotation import RPM_PER_RAD_S
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.motor_file import FrictionTable, MotorFile
from servobench.hil.configuration.motor_tables import LoadTables
from servobench.hil.configuration.twin_table import TwinKeyTable, TwinRecording, TwinTable
from servobench.hil.twin.fitting import Fit, FittedKey
from servobench.hil.twin.plant import RecordedWindow
from servobench.hil.twin.windows import WINDOW_S, octaves_of

NOT_FITTED: Final = (
    "torques, inertia and frictions are in the drive's own unit of torque, which nothing on a bus measures; "
    "resistance, inductances, flux and temperatures are the start's: a recording without voltages shows none"
)
"""What the twin says of itself, in its file and on a terminal."""
_NOT_RIGID: Final = ("coupling", "cogging")
"""Tables of a motor file that a rigid twin has not."""
_DIGITS: Final = 9
_COVARIANCE_DIGITS: Final = 6
_POWER_SHARE: Final = 0.99
"""Of the power of the set-points' changes that the band holds."""


def motor_file_of(fit: Fit) -> MotorFile:
    """Return the start with what was fitted in its place, and the table ``[twin]``."""
    start, values = fit.start, {key.name: key.value for key in fit.keys}
    inertia, coulomb = values["mechanics.inertia_kg_m2"], values["mechanics.coulomb_friction_nm"]
    mechanics = start.mechanics.model_copy(
        update={
            "inertia_kg_m2": _rounded(inertia),
            "viscous_friction_nm_s": _rounded(values["mechanics.viscous_friction_nm_s"]),
            "coulomb_friction_nm": _rounded(coulomb),
        }
    )
    load = LoadTables() if start.load is None else start.load
    load = load.model_copy(update={"hanging_nm": _rounded(values["load.hanging_nm"])})
    tables = start.model_copy(
        update={
            "mechanics": mechanics,
            "load": None if load == LoadTables() else load,
            "friction": _moved(start.friction, coulomb - start.mechanics.coulomb_friction_nm),
            **dict.fromkeys(_NOT_RIGID),
            "twin": _twin(fit),
        }
    ).tables
    return MotorFile.model_validate(tables)


def motor_text(fit: Fit) -> str:
    """Return the file."""
    head = f"# A twin of a drive, by hil fit: {NOT_FITTED}.\n\n"
    return head + toml_text(motor_file_of(fit).tables)


def left_out_of_start(fit: Fit) -> list[str]:
    """Return the tables of the start that the twin lacks, as it is rigid."""
    return [name for name in _NOT_RIGID if getattr(fit.start, name)]


def fit_json(fit: Fit) -> dict[str, Any]:
    """Return what ``hil fit --json`` prints."""
    twin = _twin(fit)
    return {
        "converged": fit.converged,
        "keys": {
            key.name: {
                "value": key.value,
                "uncertainty": key.uncertainty,
                "unit": key.unit,
                "source": key.source,
                "bias": key.bias,
            }
            for key in fit.keys
        },
        "left": dict(zip(("speed_rad_s", "position_rad", "torque_nm"), fit.spread, strict=True)),
        "twin": twin.model_dump(mode="json", exclude_none=True, exclude={"key"}),
        "not_fitted": NOT_FITTED,
        "left_out_of_start": left_out_of_start(fit),
    }


def key_text(key: FittedKey) -> str:
    """Return value and uncertainty of a key, with the unit."""
    if key.uncertainty is None:
        return f"{key.value:.6g} {key.unit}  the start's: {key.source}"
    digits = _digits(key.value, key.uncertainty)
    told = f"{key.value:.{digits}g} +- {key.uncertainty:.2g} {key.unit} (k = 2)"
    return told if key.bias is None else f"{told}, bias {key.bias:+.1g}"


def _digits(value: float, uncertainty: float) -> int:
    """So many that the uncertainty has two."""
    if not value or not uncertainty:
        return 3
    return max(2, min(10, 2 + math.floor(math.log10(abs(value))) - math.floor(math.log10(uncertainty))))


def _rounded(value: float, digits: int = _DIGITS) -> float:
    return float(f"{value:.{digits}g}")


def _moved(friction: FrictionTable | None, by_nm: float) -> FrictionTable | None:
    """Return the start's friction beside its Coulomb's, moved with that."""
    if friction is None:
        return None
    kept = {
        name: _rounded(max(0.0, getattr(friction, name) + by_nm))
        for name in ("breakaway_nm", "backward_nm")
        if getattr(friction, name) is not None
    }
    return friction.model_copy(update={**kept, "side": "motor"})


def _twin(fit: Fit) -> TwinTable:
    windows, values = fit.windows, {key.name: key.value for key in fit.keys}
    held = {each.digest for each in fit.held_out}
    speed, position, torque = (_rounded(value, 4) for value in np.max(fit.spreads, axis=0).tolist())
    return TwinTable(
        structure="rigid",
        dead_time_us=_rounded(values["twin.dead_time_us"]),
        speed_filter_hz=_rounded(values["twin.speed_filter_hz"]),
        torque_unit_nm=_rounded(abs(fit.recordings[0].stretches.torque_unit_nm)),
        window_s=WINDOW_S,
        speed_rpm=_range([window.speed_rad_s for window in windows], RPM_PER_RAD_S),
        torque_nm=_range([window.command_nm for window in windows], 1.0),
        band_hz=_band(windows),
        left=(speed, position, torque),
        left_bands=tuple(_rounded(value, 4) for value in octaves_of(fit.speed_left).tolist()),
        held_out_ratio=None if fit.held_out_ratio is None else _rounded(fit.held_out_ratio, 4),
        key=tuple(
            TwinKeyTable(
                name=key.name,
                value=_rounded(key.value),
                uncertainty=None if key.uncertainty is None else _rounded(key.uncertainty, 3),
                source=key.source,
            )
            for key in fit.keys
        ),
        covariance=tuple(
            tuple(_rounded(value, _COVARIANCE_DIGITS) for value in row) for row in fit.covariance.tolist()
        ),
        recording=tuple(
            TwinRecording(
                digest=each.digest,
                bench=each.config.bench.name,
                windows=len(each.stretches.windows),
                left_out=each.stretches.left_out,
                held_out=each.digest in held,
            )
            for each in (*fit.recordings, *fit.held_out)
        ),
    )


def _range(parts: list[Any], scale: float) -> tuple[float, float]:
    values = np.concatenate(parts)
    values = scale * values[np.isfinite(values)]
    return _rounded(float(values.min()), 4), _rounded(float(values.max()), 4)


def _band(windows: list[RecordedWindow]) -> tuple[float, float]:
    """Return from one over a window to where nearly all power of the set-points' changes lies below."""
    changes = [np.diff(window.command_nm) for window in windows if len(window.command_nm) > 2]
    count = min(len(each) for each in changes)
    period_s = float(np.median(np.diff(windows[0].at))) / NS_PER_S
    power = sum(np.abs(np.fft.rfft(each[:count])) ** 2 for each in changes)
    share = np.cumsum(power) / max(float(np.sum(power)), 1e-300)
    highest = np.fft.rfftfreq(count, period_s)[int(np.searchsorted(share, _POWER_SHARE))]
    return _rounded(1.0 / WINDOW_S, 4), _rounded(max(float(highest), 1.0 / WINDOW_S), 4)
