"""Files of a sealed recording with a bit flipped, cut off, or two bytes swapped: each is refused."""

import random
from collections.abc import Callable
from pathlib import Path

from drivers.errors import BadInput
from hil.rows.seal import check_seal
from tests.unit.hil.recorded_runs import short_run


def seal_breaker(folder: Path) -> Callable[[int], list[str]]:
    """Makes a recording in ``folder``; what is wrong with a mutant of it, by number."""
    run = short_run(folder)
    whole = {path.name: path.read_bytes() for path in run.iterdir() if path.name != "logger.log"}

    def broken(number: int) -> list[str]:
        draw = random.Random(number)
        name = draw.choice(sorted(whole))
        data = bytearray(whole[name])
        kind, one, other = draw.randrange(3), draw.randrange(len(data)), draw.randrange(len(data))
        if kind == 0:
            data[one] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del data[one:]
        else:
            data[one], data[other] = data[other], data[one]
        if data == whole[name]:
            return []
        (run / name).write_bytes(data)
        try:
            check_seal(run)
        except BadInput:
            return []
        finally:
            (run / name).write_bytes(whole[name])
        return [f"seal, mutant {number}: {name} was accepted"]

    return broken
