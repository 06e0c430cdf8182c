"""The commands that the README shows, taken out of its text.

A block of commands is fenced as ``sh``. One that stands below the line ``<!-- runs -->`` is
run by the tests as it is printed; of the others only the names are checked.
"""

import re
from dataclasses import dataclass

_BLOCK = re.compile(r"(?P<mark><!-- runs -->\n+)?^```sh\n(?P<text>.*?)^```$", re.MULTILINE | re.DOTALL)
_TARGET = re.compile(r"^([a-z][a-z-]*):", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block of commands."""

    text: str
    runs: bool
    """Whether the tests run it."""

    def commands(self) -> list[list[str]]:
        """The words of each command, without comments and without the lines' continuation."""
        joined = self.text.replace("\\\n", " ")
        lines = (line.partition(" #")[0].strip() for line in joined.splitlines())
        simple = [
            part for line in lines if not line.startswith("#") for part in re.split(r"&&|\|\||[;|&]", line)
        ]
        return [part.split() for part in simple if part.strip()]


def blocks(markdown: str) -> list[Block]:
    """The blocks of commands, in order."""
    return [Block(found["text"], found["mark"] is not None) for found in _BLOCK.finditer(markdown)]


def make_targets(makefile: str) -> set[str]:
    """The targets that have a rule of their own name."""
    return set(_TARGET.findall(makefile))
