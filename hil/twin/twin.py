"""``servobench.fit``: a twin from recordings, in Python; imports happen at the call."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servobench.hil.configuration.motor_file import MotorFile
    from servobench.hil.twin.fitting import Fit, FittedKey
    from servobench.hil.twin.twin_drive import RunLike

    Source = str | os.PathLike[str] | RunLike


@dataclass(frozen=True)
class Twin:
    """A drive as recordings show it, with the uncertainty of each key."""

    found: "Fit"

    @property
    def keys(self) -> "dict[str, FittedKey]":
        """By name: ``value``, ``uncertainty`` (k = 2; None where it is the start's), ``unit``, ``source``."""
        return {key.name: key for key in self.found.keys}

    @property
    def held_out_ratio(self) -> float | None:
        """Error on the recording held out, over that on those that were fitted; None: none was."""
        return self.found.held_out_ratio

    @cached_property
    def motor(self) -> "MotorFile":
        """The motor file, with its table ``[twin]``; its ``tables`` go into a bench."""
        from servobench.hil.twin.twin_file import motor_file_of

        return motor_file_of(self.found)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the motor file. Raises BadInput."""
        from servobench.drivers.written_file import write_file
        from servobench.hil.twin.twin_file import motor_text

        write_file("path", Path(path), motor_text(self.found))

    def as_json(self) -> dict[str, Any]:
        """Return what ``hil fit --json`` prints."""
        from servobench.hil.twin.twin_file import fit_json

        return fit_json(self.found)


def fit(
    recordings: "Source | Sequence[Source]",
    *,
    start: "str | os.PathLike[str] | MotorFile | None" = None,
    hold_out: "Source | None" = None,
    fixed: Sequence[str] = (),
    axis: str | None = None,
    bootstrap: int = 0,
    unsealed: bool = False,
) -> Twin:
    """Fit the simulated drive to recordings of one drive, with a rigid shaft; see ``hil docs twin``.

    ``recordings``: folders, or a :class:`Run` or several. ``start``: a motor file, which keeps its value for
    what the recordings do not determine; default: the motor of the first recording's bench. ``hold_out``: a
    recording that is predicted, not fitted. ``fixed``: keys that keep the start's value. ``axis``: of a bench
    with several. ``bootstrap``: how many times the twin itself is recorded and fitted, for the bias and for
    widths that are no narrower than that shows. Raises BadInput or BadInputs.
    """
    from servobench.hil.configuration.motor_file import MotorFile, load_motor
    from servobench.hil.twin.fitting import fit_recordings

    def source(given: "Source") -> "Path | RunLike":
        return Path(given) if isinstance(given, str | os.PathLike) else given

    several = isinstance(recordings, Sequence) and not isinstance(recordings, str)
    chosen: Sequence[Any] = recordings if several else [recordings]  # type: ignore[assignment]
    motor = start if start is None or isinstance(start, MotorFile) else load_motor(Path(start))
    return Twin(
        fit_recordings(
            [source(each) for each in chosen],
            start=motor,
            hold_out=None if hold_out is None else source(hold_out),
            fixed=fixed,
            axis=axis,
            bootstrap=bootstrap,
            unsealed=unsealed,
        )
    )
