"""The modes in which a bench runs a drive, and what `hil run` can do with a drive that has some of them: in
one set of words for every command and for the README."""

from collections.abc import Collection
from typing import Final

from drivers.cia402.profile import Mode

BENCH_MODES: Final = {
    "cst": Mode.CYCLIC_SYNCHRONOUS_TORQUE,
    "csv": Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    "csp": Mode.CYCLIC_SYNCHRONOUS_POSITION,
}
"""By ``drive.NAME.mode`` of a bench file."""

RULE: Final = (
    '`hil run` needs cyclic synchronous torque (`mode = "cst"`), velocity (`"csv"`) or position (`"csp"`); a '
    "drive with none of them can be commissioned, not run"
)


def run_words(modes: Collection[Mode]) -> str:
    """What `hil run` can do with a drive that has ``modes``."""
    usable = [f'"{key}"' for key, mode in BENCH_MODES.items() if mode in modes]
    if not usable:
        return RULE
    return f"`hil run` can use it with mode = {' or '.join(usable)}"
