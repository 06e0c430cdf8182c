"""Texts beside those that were last looked at, word by word and number by number.

Every text is of a seeded session in simulated time, so nothing but a change of the code, or of what numpy
makes of the last bits, changes it. Whether the figures are right is asked elsewhere, by witnesses; here, that
each is told, in its unit, in its place, and that none moves unnoticed. After a change that is meant, look at
what

    SERVOBENCH_TELL_ANEW=1 pytest tests/unit -k told; git diff tests/unit

shows, and commit it.
"""

import os
import re
from pathlib import Path
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[1]
ANEW: Final = "SERVOBENCH_TELL_ANEW"
NUMBER: Final = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")
CHANGING: Final = (
    (re.compile(r" +"), " "),
    (re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?([+-]\d\d:\d\d|Z)?"), "DATE"),
    (re.compile(r"servobench \d[\w.+]*"), "servobench VERSION"),
    (re.compile(r"(Computing|Pace|Open with|min_margin) .*"), r"\1"),
    (re.compile(r"(simulated servo drive)( [0-9a-f]{10}\S*)?(?= (one|two)$)", re.MULTILINE), r"\1 COMMIT"),
    (re.compile(r'"compute_us": [{][^}]*[}]'), '"compute_us"'),
    (re.compile(r" [\d.]+/s .* left at most|[\d.]+ runs a second"), ""),
    (re.compile(r"<svg.*?</svg>", re.DOTALL), ""),
)
"""What no two runs have in common; the last bits of a solver."""
AS_NEAR: Final = 2e-3
"""Texts are rounded to three digits and more; the last of them may go either way."""


def hold(text: str, path: Path) -> None:
    """Against what the file holds. Raises AssertionError."""
    text = text.replace(str(ROOT), "ROOT")
    for pattern, word in CHANGING:
        text = pattern.sub(word, text)
    text = "\n".join(line.rstrip() for line in text.splitlines()) + "\n"
    if os.environ.get(ANEW):
        path.write_text(text, encoding="utf-8")
    told = path.read_text(encoding="utf-8")
    assert NUMBER.sub("#", text).splitlines() == NUMBER.sub("#", told).splitlines()
    pairs = zip(text.splitlines(), told.splitlines(), strict=True)
    moved = [
        pair for pair in pairs if _numbers(pair[0]) != pytest.approx(_numbers(pair[1]), rel=AS_NEAR, abs=1e-9)
    ]
    assert moved == []


def _numbers(line: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(line)]
