"""Losses as a network makes them at random: independent, or in bursts; on the way to the host and back.

A link is in a good or in a bad state, which moves before each frame; each state loses frames with its own
probability (Gilbert 1960, Elliott 1963). Both links together are a chain of up to four hidden states. A
period's outcome tells which of its two frames were lost.
"""

from typing import NamedTuple

import numpy as np

from servobench.design.delay.delay_loop import Array


class LossyLink(NamedTuple):
    """Losses on one link, each figure a probability; independent ones have ``loss_good`` alone."""

    p_good_to_bad: float = 0.0
    p_bad_to_good: float = 1.0
    loss_bad: float = 1.0
    loss_good: float = 0.0

    @property
    def loss(self) -> float:
        """Share of lost frames in the long run."""
        came, lost = self.outcomes()
        at = stationary(came + lost)
        return float((at @ lost).sum())

    def outcomes(self) -> Array:
        """Return (2, m, m) probabilities to move from state to state and have the frame come, or be lost."""
        if self.p_good_to_bad == 0.0:
            return np.array([[[1.0 - self.loss_good]], [[self.loss_good]]])
        up, down = self.p_good_to_bad, self.p_bad_to_good
        moves = np.array([[1.0 - up, up], [down, 1.0 - down]])
        lost = np.array([self.loss_good, self.loss_bad])
        return np.array([moves * (1.0 - lost), moves * lost])


class Outcome(NamedTuple):
    """Frames of one period that were lost."""

    reading: bool
    command: bool


class Fates(NamedTuple):
    """Outcomes that have a probability, and for each of them (m, m) from hidden state to hidden state."""

    outcomes: tuple[Outcome, ...]
    moves: Array
    """(outcomes, m, m)."""


def fates_of(readings: LossyLink, commands: LossyLink) -> Fates:
    """Return those of two links that know nothing of one another."""
    both = {
        Outcome(bool(i), bool(j)): np.kron(reading, command)
        for i, reading in enumerate(readings.outcomes())
        for j, command in enumerate(commands.outcomes())
    }
    possible = {outcome: moves for outcome, moves in both.items() if moves.any()}
    return Fates(tuple(possible), np.array(list(possible.values())))


def stationary(moves: Array) -> Array:
    """Return the (m,) distribution that ``moves`` (m, m), rows from, leaves as it is."""
    one = np.ones(len(moves))
    return np.asarray(np.linalg.solve(np.eye(len(moves)) - moves.T + 1.0, one))
