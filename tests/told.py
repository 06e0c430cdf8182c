"""Texts beside those that were last looked at, word by word and number by number.

Every text is of a seeded session in simulated time, so nothing but a change of the code, or of what numpy
makes of the last bits, changes it. Whether the figures are right is asked elsewhere, by witnesses; here, that
each is told, in its unit, in its place, and that none moves unnoticed. After a change that is meant, look at
what

    SERVOBENCH_TELL_ANEW=1 pytest tests/unit -k told; git diff tests/unit

shows, and commit it.
"""

import copy
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from difflib import unified_diff
from itertools import islice
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.errors import BenchError

ROOT: Final = Path(__file__).parents[1]
ANEW: Final = "SERVOBENCH_TELL_ANEW"
MEANT: Final = f"Is that meant? {ANEW}=1 pytest tests/unit -k told; git diff tests/unit"
NUMBER: Final = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")
CHANGING: Final = (
    (re.compile(r" +"), " "),
    (re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?([+-]\d\d:\d\d|Z)?"), "DATE"),
    (re.compile(r"\d{8}T\d{6}Z"), "DATE"),
    (re.compile(r"host `.*"), "host HOST, servobench VERSION"),
    (re.compile(r"servobench \d[\w.+]*"), "servobench VERSION"),
    (
        re.compile(r"(Computing|computing time|times real time|Pace|Open with|min_margin) .*"),
        r"\1",
    ),
    (re.compile(r"commands_computing [^,)]+"), "commands_computing"),
    (re.compile(r"(simulated servo drive)( [0-9a-f]{10}\S*)?(?= (one|two)$)", re.MULTILINE), r"\1 COMMIT"),
    (re.compile(r'"(compute_us|realtime_factor)": ([{][^}]*[}]|[\d.]+)'), r'"\1"'),
    (re.compile(r" [\d.]+/s .* left at most|[\d.]+ runs a second"), ""),
    (re.compile(r"that folder holds .*"), "that folder holds FILES"),
    (re.compile(r"[━─═]+"), "─"),
    (re.compile(r"\b\d\.\d+e-(0[89]|1\d)\b"), "NEARLY-NOTHING"),
    (re.compile(r"(?<=gap_percent )0\.0\d+"), "NEARLY-NOTHING"),
    (re.compile(r"\.\d+-\d+\.writing"), "PART"),
    (re.compile(r"<svg.*?</svg>", re.DOTALL), ""),
)
"""What no two runs have in common; the last bits of a solver."""
AS_NEAR: Final = 2e-3
"""Texts are rounded to three digits and more; the last of them may go either way."""


def hold(text: str, path: Path) -> None:
    """Against what the file holds. Raises AssertionError, with what differs and how a text is told anew."""
    text = text.replace(str(ROOT), "ROOT")
    for pattern, word in CHANGING:
        text = pattern.sub(word, text)
    text = "\n".join(line.rstrip() for line in text.splitlines()) + "\n"
    if os.environ.get(ANEW):
        path.write_text(text, encoding="utf-8")
    told = path.read_text(encoding="utf-8")
    changed = "\n".join(islice(unified_diff(told.splitlines(), text.splitlines(), lineterm="", n=0), 2, 12))
    assert NUMBER.sub("#", text) == NUMBER.sub("#", told), f"{path.name}:\n{changed}\n{MEANT}"
    pairs = zip(text.splitlines(), told.splitlines(), strict=True)
    moved = [
        pair for pair in pairs if _numbers(pair[0]) != pytest.approx(_numbers(pair[1]), rel=AS_NEAR, abs=1e-9)
    ]
    assert moved == [], MEANT


def _numbers(line: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(line)]


VALUES: Final = (-1, 0, 1, 0.5, 1e12, "x", True)
"""What is put in the place of every value in turn; beside that it is left out."""
_ENTRIES_MAX: Final = 1
"""Of a list: the others are like them."""


def struck(tables: Mapping[str, Any], load: Callable[[dict[str, Any]], object]) -> list[str]:
    """What ``load`` says of ``tables`` with each value left out and replaced in turn, a line an answer."""
    lines = []
    for path in _paths(tables):
        answers: dict[str, list[str]] = {}
        for value in (None, *VALUES):
            changed = copy.deepcopy(dict(tables))
            node: Any = changed
            for step in path[:-1]:
                node = node[step]
            if value is None:
                del node[path[-1]]
            else:
                node[path[-1]] = value
            try:
                load(changed)
            except BenchError as error:
                answer = re.sub(r"(found .*?|missing), expected", "expected", str(error))
            else:
                answer = "accepted"
            answers.setdefault(answer, []).append(f"{value!r}")
        name = ".".join(map(str, path))
        lines += [f"{name} = {', '.join(values)}: {answer}" for answer, values in answers.items()]
    return lines


def _paths(node: object, above: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    children: Iterable[tuple[str | int, object]] = ()
    if isinstance(node, Mapping):
        children = node.items()
    elif isinstance(node, list):
        children = enumerate(node[:_ENTRIES_MAX])
    for step, child in children:
        yield (*above, step)
        yield from _paths(child, (*above, step))
