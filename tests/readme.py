"""The commands that a document shows, taken out of its text.

A block of commands is fenced as ``sh``. What the tests do with it says the comment above it:

``<!-- runs -->``
    it is run as it is printed, in order, with the others of its document, in one folder;
none
    it needs hardware, root or long, and is held against the program: commands, options and their values.

A command ends with status 0 unless the comment behind it says ``# status N``; behind one that ends with ``&``
the next begins at once, as in a shell. Of a block of another language

``<!-- file NAME -->``, ``<!-- append NAME -->``
    is what the user is asked to write into that file, or to its end,
``<!-- printed -->``
    is what the commands above it have printed: each line is among it, but for a line of dots.
"""

import re
import shlex
from dataclasses import dataclass

_BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>runs|printed|(?:file|append) (?P<file>\S+)) -->\n+)?"
    r"```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
_TARGET = re.compile(r"^([a-z][a-z-]*):", re.MULTILINE)
_STATUS = re.compile(r"#.*\bstatus (\d+)\b")
_SEPARATORS = {"&&", "||", ";", "|", "&"}
INDENTED = re.compile(r"^    (?:hil|pytest) [a-z-].*$", re.MULTILINE)
"""Commands that are not fenced, so that nobody would look at them."""
END = "end of the file"
WITHOUT_WORDS = str.maketrans("", "", "│╭╮╰╯─")
"""A frame around a text depends on the width of the terminal."""
DID = 'did() { [ -z "${TYPED:-}" ] || echo "$((SECONDS - from)) s  $1" >>"$TYPED"; from=$SECONDS; }; from=0'
"""Into the file that TYPED names, if any, goes each command that did what it should, and its seconds."""


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block."""

    text: str
    language: str
    mark: str
    """What the comment above it says; empty without."""
    file: str | None = None

    @property
    def runs(self) -> bool:
        """Whether the tests run it."""
        return self.mark == "runs"

    def lines(self) -> list[str]:
        """The commands' lines, continued ones joined, with their comments."""
        return [line for line in self.text.replace("\\\n", " ").splitlines() if line.strip()]

    def commands(self) -> list[list[str]]:
        """The words of each command, without comments and without the lines' continuation."""
        found: list[list[str]] = []
        for line in self.lines():
            words = shlex.shlex(line, posix=True, punctuation_chars="|&;")
            words.whitespace_split = True
            found.append([])
            for word in words:
                if word in _SEPARATORS:
                    found.append([])
                else:
                    found[-1].append(word)
        return [command for command in found if command]

    def printed(self) -> list[str]:
        """The lines of what was printed, each without its blanks."""
        lines = [squeezed(line) for line in self.text.splitlines()]
        return [line for line in lines if line.strip(".")]


def squeezed(text: str) -> str:
    """``text`` without blanks and without the frames around it."""
    return "".join(text.translate(WITHOUT_WORDS).split())


def blocks(markdown: str) -> list[Block]:
    """The blocks of a document, in order."""
    return [
        Block(found["text"], found["language"], found["mark"] or "", found["file"])
        for found in _BLOCK.finditer(markdown)
    ]


def shell_blocks(markdown: str) -> list[Block]:
    """The blocks of commands, in order."""
    return [block for block in blocks(markdown) if block.language == "sh"]


def script(parts: list[Block]) -> str:
    """What bash is to run: the files as they are to be written, and the commands held to their status."""
    text = ["set -uo pipefail", "trap 'kill $(jobs -p) 2>/dev/null; wait' EXIT", DID]
    for block in parts:
        if block.file is not None:
            into = ">>" if block.mark.startswith("append") else ">"
            text.append(f"cat {into}{shlex.quote(block.file)} <<'{END}'\n{block.text}{END}")
        elif block.runs:
            text += [_held(line, number) for number, line in enumerate(block.lines())]
    return "\n".join(text) + "\n"


def _held(line: str, number: int) -> str:
    """``line`` with the check that the document's reader makes."""
    command = line.partition(" #")[0].rstrip()
    wanted = int(found[1]) if (found := _STATUS.search(line)) else 0
    told = shlex.quote(command)
    if command.endswith("&"):
        return f"{command[:-1]} >served.{number} 2>&1 &\ndid {told}"
    return (
        f"{command}\n"
        f"status=$?; [ $status -eq {wanted} ] || {{ echo status $status, not {wanted}: {told}; exit 1; }}\n"
        f"did {told}"
    )


def make_targets(makefile: str) -> set[str]:
    """The targets that have a rule of their own name."""
    return set(_TARGET.findall(makefile))
