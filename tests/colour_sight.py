"""How far colours are apart to the eye, and to one without a kind of cone.

Machado, Oliveira and Fernandes (2009), A physiologically-based model for simulation of color vision
deficiency, severity 1; distances by CIE 1976 L*a*b*, D65.
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

SIGHTS: Final = {
    "all": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}
"""What is seen of linear RGB."""
_XYZ: Final = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


def seen(colors: ArrayLike, sight: str) -> NDArray[np.float64]:
    """Linear RGB, 0 to 1, of sRGB colours, (..., 3), 0 to 255."""
    coded = np.asarray(colors, np.float64) / 255.0
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    through: NDArray[np.float64] = linear @ SIGHTS[sight].T
    return through.clip(0.0, 1.0)


def cielab(colors: ArrayLike, sight: str) -> NDArray[np.float64]:
    """L*, a*, b* of sRGB colours, (..., 3), as one sees them."""
    ratio = seen(colors, sight) @ _XYZ.T / np.array([0.95047, 1.0, 1.08883])
    x, y, z = np.moveaxis(
        np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116), -1, 0
    )
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def apart(one: ArrayLike, other: ArrayLike) -> float:
    """Distance of two sRGB colours to the eye that tells them apart worst."""
    return min(float(np.linalg.norm(cielab(one, sight) - cielab(other, sight))) for sight in SIGHTS)


def contrast(one: ArrayLike, other: ArrayLike) -> float:
    """Contrast of two sRGB colours, 1 to 21 (WCAG 2)."""
    dark, light = sorted(float((seen(each, "all") @ _XYZ[1]).item()) + 0.05 for each in (one, other))
    return light / dark
