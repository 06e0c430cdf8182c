"""What may become of a file, drawn from its kind and a number; and what must be true of whoever loads it."""

import os
import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from servobench.drivers.errors import BadInput, printable
from servobench.hil.configuration.config_files import BadInputs, bad_inputs_of

PROCESSOR_S_MAX: Final = 2.0
"""What any input may cost; the patterns that were cubic took hours for some."""
MESSAGE_MAX: Final = 2000
"""Characters of one error: what it repeats of the file is bounded, and so are the keys that it names."""
NUMBERS: Final = [
    *(b"1e308", b"-1e308", b"5e-324", b"1e400", b"nan", b"inf", b"-0", b"1_0", b"0x10", b"true"),
    *(b"18446744073709551616", b"9" * 400, b"9" * 5000, b"1e" + b"9" * 300, b"1." + b"9" * 100_000),
    *(b"\xc2\xb2", b"'1'", b"", b"2021-02-30"),
]
INSERTS: Final = [
    *(b"[" * 3000, b"{" * 3000, b'{"a":' * 3000, b"a." * 50_000, b"k" * 100_000, b'"""', b"'''", b'"', b"#"),
    *(b"\x00", b"\xff\xfe", b"\x1b[2J", b'"\\u001b"', b"\xe2\x80\xae", b"="),
    *(b"\n[" + b" " * 20_000, b"\r" * 20_000),
]


@dataclass(frozen=True)
class Kind:
    """A kind of file: one that is sound, and what loads it."""

    name: str
    sound: bytes
    load: Callable[[Path], object]


def mutant(name: str, sound: bytes, number: int) -> bytes:
    """Another number, something put in, the end torn off, octets overwritten: each in turn."""
    draw = random.Random(f"{name} {number}")
    numbers = [match.span() for match in re.finditer(rb"[0-9][0-9._]*", sound)] or [(0, 0)]
    place = draw.randrange(max(1, len(sound)))
    manner = number % 4
    if manner == 0:
        begin, end = draw.choice(numbers)
        return sound[:begin] + draw.choice(NUMBERS) + sound[end:]
    if manner == 1:
        return sound[:place] + draw.choice(INSERTS) + sound[place:]
    if manner == 2:
        return sound[:place]
    return sound[:place] + draw.randbytes(4) + sound[place + draw.randrange(9) :]


def processor_s() -> float:
    """Of this process, user and system."""
    times = os.times()
    return times.user + times.system


def failures(kind: Kind, number: int, path: Path) -> list[str]:
    """What is wrong with how mutant ``number``, written to ``path``, is loaded."""
    path.write_bytes(mutant(kind.name, kind.sound, number))
    begun = processor_s()
    found: list[str] = []
    try:
        kind.load(path)
    except (BadInput, BadInputs) as error:
        for text in map(str, bad_inputs_of(error)):
            if printable(text) != text or len(text) >= MESSAGE_MAX:
                found.append(f"an error of {len(text)} characters: {printable(text[:200])}")
    except BaseException as error:
        error.add_note(f"mutant {number} of {kind.name}")
        raise
    took_s = processor_s() - begun
    if took_s > PROCESSOR_S_MAX:
        found.append(f"it took {took_s:.1f} s")
    return [f"{kind.name} {number}: {text}" for text in found]
