"""An attack on certified peaks over losses, inertias and delays: ``python -m tests.attack --seconds 600``.

Drawn loops are certified here and attacked in another process, whose simulation and search are its own
(:mod:`tests.attack.simulation`). No attack may exceed what is certified.
"""

import argparse
import json
import signal
import subprocess
import sys
from typing import NamedTuple

import numpy as np

from servobench.design.errors import NoSolution
from servobench.hil.studies.speed.loss_peaks import peak_of
from tests.attack.drawn import drawn_loop


class Attacked(NamedTuple):
    """A loop that was certified and attacked, rad/s per N m."""

    kind: str
    inertia_percent: float
    """By how much it may differ, either way."""
    delay_ms: tuple[float, float]
    certified: float
    reached: float
    attacked: float

    @property
    def ratio(self) -> float:
        """Certified over the most that either search found."""
        return self.certified / max(self.reached, self.attacked)

    @property
    def violated(self) -> bool:
        """True if the attack exceeds what is certified."""
        return self.attacked > self.certified * (1.0 + 1e-6)


class Attack:
    """The process."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.attack.simulation"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def on(self, told: dict[str, object]) -> float:
        """Return the largest error that is reached."""
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(told) + "\n")
        process.stdin.flush()
        return float(process.stdout.readline())

    def close(self) -> None:
        """End it, in the middle of an attack too."""
        self._process.kill()
        self._process.communicate()


def attacked(seed: int, attack: Attack) -> Attacked | None:
    """Certify and attack the loop of ``seed``; None: nothing is certified."""
    drawn = drawn_loop(seed)
    if drawn is None:
        return None
    try:
        bound = peak_of(drawn.controller, drawn.readings, drawn.commands, drawn.inertias, drawn.delays)
    except NoSolution:
        return None
    differs = 100.0 * (drawn.inertias[1] - 1.0)
    least, most = (1e3 * each for each in drawn.told["delays"])
    return Attacked(
        drawn.told["kind"], differs, (least, most), bound.certified, bound.reached, attack.on(drawn.told)
    )


class _TimeIsUp(Exception):
    pass


def _stopped(*_: object) -> None:
    raise _TimeIsUp


def main() -> int:
    """Return 1 if any attack succeeded."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--loops", type=int, default=500, help="certified ones, at most")
    parser.add_argument("--first", type=int, default=0, help="seed to begin with, to go on")
    parser.add_argument("--seconds", type=float, default=3600.0)
    asked = parser.parse_args()
    attack, done, seed, uncertified = Attack(), list[Attacked](), asked.first, 0
    signal.signal(signal.SIGALRM, _stopped)
    signal.setitimer(signal.ITIMER_REAL, asked.seconds)
    while len(done) < asked.loops:
        try:
            found = attacked(seed, attack)
        except _TimeIsUp:  # the loop in hand is left to the next run
            break
        if found is None:
            uncertified += 1
        else:
            done.append(found)
            print(
                f"{seed:5} {found.kind:9} J +-{found.inertia_percent:2.0f} %"
                f" delay {found.delay_ms[0]:6.3f} to {found.delay_ms[1]:6.3f} ms"
                f" certified {found.certified:10.4f} found {found.reached:10.4f}"
                f" attacked {found.attacked:10.4f}  {found.ratio:.3f}{'  VIOLATED' * found.violated}",
                flush=True,
            )
        seed += 1
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    attack.close()
    if not done:
        print(f"no loop was certified and attacked in {asked.seconds:g} s; next seed {seed}")
        return 1
    violations = sum(each.violated for each in done)
    ratios = np.array([each.ratio for each in done])
    print(
        f"{len(done)} loops attacked, {uncertified} without a certificate (unstable ones among them), "
        f"{violations} violations; certified over found: median {np.median(ratios):.3f}, "
        f"p95 {np.percentile(ratios, 95):.3f}, worst {ratios.max():.3f}; above 1.10: {(ratios > 1.1).sum()}, "
        f"above 2: {(ratios > 2.0).sum()}; next seed {seed}"
    )
    return 1 if violations else 0


if __name__ == "__main__":
    raise SystemExit(main())
