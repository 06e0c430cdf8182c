"""``hil verify``: what controllers' files claim, proved from their digits; and what is false, refused."""

import random
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from servobench.design.sampled.analysis import analyse_loop
from servobench.design.verify.balls import Ball, NotProved, require_positive
from servobench.design.verify.file import claims_of, table_of
from servobench.hil.cli import app
from tests.benchmarks.attack_peaks import DrawnLoop
from tests.benchmarks.verify_certificates import certified_loops, false_claims, table_of_loop

CONTROLLERS = Path("examples/controllers")
PREDICTOR, HINF, FUSED = (CONTROLLERS / f"ling2012-{kind}.toml" for kind in ("predictor", "hinf", "fused"))

INERTIA = r"(\[controller.made_for.plant\]\n(.*\n){2})inertia_kg_m2 = 0.0008"
"""Of the plant that the proof is about."""


def verify(*files: Path) -> Result:
    return CliRunner().invoke(app, ["verify", *map(str, files)])


def changed(path: Path, folder: Path, old: str, new: str) -> Path:
    """Write the file anew with one line changed, and without its digest."""
    text = re.sub(r"^digest = .*\n", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert re.search(old, text, re.MULTILINE)
    file = folder / path.name
    file.write_text(re.sub(old, new, text, count=1, flags=re.MULTILINE), encoding="utf-8")
    return file


@pytest.mark.long
def test_the_files_of_the_examples_are_proved() -> None:
    names = ("ling2012-static", "network-k", "ling2012-hinf", "ling2012-predictor", "ling2012-fused")
    done = verify(*(CONTROLLERS / f"{name}.toml" for name in names))
    assert done.exit_code == 0, done.output
    assert done.output.count(": proved") == 10
    assert "changed" not in done.output


def test_a_changed_digit_is_noticed(tmp_path: Path) -> None:
    draw = random.Random(40)
    text = HINF.read_text(encoding="utf-8")
    digits = [found.start() for found in re.finditer(r"\d", text)]
    for number, place in enumerate(draw.sample(digits, 25)):
        other = draw.choice([digit for digit in "0123456789" if digit != text[place]])
        file = tmp_path / f"{number}.toml"
        file.write_text(text[:place] + other + text[place + 1 :], encoding="utf-8")
        assert verify(file).exit_code in (1, 2), text[place - 40 : place + 10]


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (HINF, r"^gain_certified = .*", "gain_certified = 9.68", "= 9.68 rad/s per N m: not proved"),
        (HINF, r"^decay_certified_per_s = .*", "decay_certified_per_s = 112.9", "not proved"),
        (HINF, INERTIA, r"\g<1>inertia_kg_m2 = 0.0004", "not proved"),
        (PREDICTOR, r"^load_noise_nm_sqrt_s = .*", "load_noise_nm_sqrt_s = 1.2", "filter_gains after 0"),
        (FUSED, r"^gain_certified = .*", "gain_certified = 27.41", "= 27.41 rad/s per N m: not proved"),
        (FUSED, r"^gains = \[\[\[", "gains = [[[1", "not proved"),
        (HINF, r"^losses_in_a_row_max = 1\nsolver", "losses_in_a_row_max = 2\nsolver", "not proved"),
    ],
)  # fmt: skip
def test_another_loop_or_figure_is_not_proved(
    tmp_path: Path, file: Path, old: str, new: str, words: str
) -> None:
    """Each beyond what a known pattern of losses does, or beyond what the matrices were made for."""
    done = verify(changed(file, tmp_path, old, new))
    assert done.exit_code == 1
    assert words in done.output
    assert "without a digest" in done.output


@pytest.mark.parametrize(
    ("file", "old", "words"),
    [
        (CONTROLLERS / "azaiz2007-speed.toml", "", "controller.certificate.sequences: found 'nothing'"),
        (PREDICTOR, r"^filter_gains = .*\n", "controller.certificate.filter_gains: found 'nothing'"),
        (HINF, r"^dead_time_us = .*\n", "controller.certificate.dead_time_us: found 'nothing'"),
    ],
)
def test_a_file_that_cannot_be_checked_is_refused(tmp_path: Path, file: Path, old: str, words: str) -> None:
    done = verify(changed(file, tmp_path, old, "") if old else file)
    assert done.exit_code == 2
    assert words in " ".join(done.output.split())


def test_drawn_certificates_are_proved_and_false_claims_of_them_are_not() -> None:
    """The same matrices with figures that a known pattern of losses and delays breaks by a millionth."""
    for seed in (4101, 4102, 4105, 4107):  # whose certificates take a second together
        drawn, analysis = next(certified_loops(seed))
        table = table_of_loop(drawn, analysis)
        assert [claim.refused for claim in claims_of(table)] == ["", ""], drawn
        assert all(claim.refused for claim in claims_of(false_claims(table, analysis))), drawn


def test_what_lies_between_two_instants_of_a_grid_counts() -> None:
    """In cells as wide as the windows the departure from a chord is beyond every slack."""
    table = table_of(CONTROLLERS / "network-k.toml")
    assert [claim.refused for claim in claims_of(table)] == ["", ""]
    assert all(claim.refused for claim in claims_of(table, room=1e9))


@pytest.mark.long
def test_order_cuts_the_cells_of_windows_that_overlap() -> None:
    """A delay of 1.34 periods: the windows of two samples have different instants, and in cells that are no
    squares the ordered corners left out some of the steps; this decay was 3e-5 of itself too fast."""
    drawn = DrawnLoop(
        "arrival",
        0.000933,
        0,
        0.001252,
        0.0,
        349.52010203816207,
        (-0.11312276510700475, -0.17577665041742255),
    )
    table = table_of_loop(drawn, analyse_loop(drawn.loop()))
    assert [claim.refused for claim in claims_of(table)] == ["", ""]


def exactly(matrix: np.ndarray) -> list[list[Fraction]]:
    return [[Fraction(float(entry)) for entry in row] for row in matrix]


def holds(ball: Ball, truth: list[list[Fraction]]) -> bool:
    return all(
        abs(Fraction(float(mid)) - entry) <= Fraction(float(rad))
        for mids, rads, row in zip(ball.mid, ball.rad, truth, strict=True)
        for mid, rad, entry in zip(mids, rads, row, strict=True)
    )


def test_balls_hold_what_fractions_say() -> None:
    draw = np.random.default_rng(41)
    for _ in range(40):
        n = int(draw.integers(1, 6))
        mids = draw.normal(size=(2, n, n)) * 10.0 ** draw.integers(-6, 6, size=(2, n, n))
        rads = np.abs(mids) * 10.0 ** draw.uniform(-16, -3, size=(2, n, n))
        one, other = (Ball(mid, rad) for mid, rad in zip(mids, rads, strict=True))
        a, b = (
            exactly(mid + draw.uniform(-0.99, 0.99, size=(n, n)) * rad)
            for mid, rad in zip(mids, rads, strict=True)
        )
        product = [
            [sum((a[i][k] * b[k][j] for k in range(n)), Fraction(0)) for j in range(n)] for i in range(n)
        ]
        assert holds(one @ other, product)
        assert holds(one + other, [[a[i][j] + b[i][j] for j in range(n)] for i in range(n)])
        assert holds(one.times(0.3), [[Fraction(0.3) * a[i][j] for j in range(n)] for i in range(n)])


def test_inverses_hold_what_fractions_say() -> None:
    draw = np.random.default_rng(42)
    for _ in range(40):
        mid = np.eye(2) + draw.uniform(-0.4, 0.4, size=(2, 2))
        rad = np.full((2, 2), 10.0 ** draw.uniform(-16, -3))
        (a, b), (c, d) = exactly(mid + draw.uniform(-0.99, 0.99, size=(2, 2)) * rad)
        size = a * d - b * c
        assert holds(Ball(mid, rad).inverse(), [[d / size, -b / size], [-c / size, a / size]])


@pytest.mark.parametrize("excess", [1e-9, -1e-9])
def test_a_matrix_is_positive_only_if_all_in_its_ball_are(excess: float) -> None:
    """The least eigenvalue of [[2, 1], [1, 2]] - c is 1 - c; a radius of r takes away 2 r."""
    radius = 1e-6
    edge = Ball(
        np.array([[1.0 + 2.0 * radius + excess, 1.0], [1.0, 1.0 + 2.0 * radius + excess]]),
        np.full((2, 2), radius),
    )
    with pytest.raises(NotProved):
        require_positive(edge, "here")
    wide = Ball(edge.mid + 4.0 * radius * np.eye(2), edge.rad)
    require_positive(wide, "here")
