"""Curves over frequency as text, for a terminal."""

import math
from collections.abc import Mapping, Sequence

WIDTH, HEIGHT = 64, 11


def plot(
    title: str,
    frequency_rad_s: Sequence[float],
    curves: Mapping[str, Sequence[float]],
    range_db: tuple[float, float],
) -> str:
    """Each curve (k,) in dB by the letter it is named with, over the logarithm of the k frequencies.

    A curve that is named later is drawn over the ones before it.
    """
    low, high = range_db
    ends = math.log10(frequency_rad_s[0]), math.log10(frequency_rad_s[-1])
    rows = [[" "] * WIDTH for _ in range(HEIGHT)]
    for letter, values in curves.items():
        for omega, value in zip(frequency_rad_s, values, strict=True):
            column = round((math.log10(omega) - ends[0]) / (ends[1] - ends[0]) * (WIDTH - 1))
            row = round((high - value) / (high - low) * (HEIGHT - 1))
            if 0 <= row < HEIGHT:
                rows[row][column] = letter
    step = (high - low) / (HEIGHT - 1)
    lines = [f"{high - step * k:8.0f} |{''.join(row).rstrip()}" for k, row in enumerate(rows)]
    left, right = f"{frequency_rad_s[0]:.0e}", f"{frequency_rad_s[-1]:.0e} rad/s"
    axis = f"{left}{right:>{WIDTH - len(left)}}"
    return "\n".join([f"{title}, dB", *lines, f"{'':8} +{'-' * WIDTH}", f"{'':10}{axis}"])
