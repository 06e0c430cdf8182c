"""Pages of HTML as a browser shows them: each at three sizes, light and dark."""

import io
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path
from typing import Any, Final

import matplotlib.image
import numpy as np
from numpy.typing import NDArray

from tests.colour_sight import apart, contrast
from tests.pictures import made
from tests.pictures.browser import Browser, browser

SIZES: Final = ((390, 844), (1366, 768), (1920, 1080), (3840, 2160))
GROUNDS: Final = {"light": (255, 255, 255), "dark": (18, 18, 18)}
"""What Chromium lays below a page."""
_READABLE: Final = 4.5
"""Contrast that WCAG 2 asks of text."""
_APART: Final = 40.0
"""CIELAB, to the eye that tells them apart worst."""
_NARROWEST: Final = 0.5
"""So much of a screen's width a page takes at least."""
_PROBE: Final = """(() => {
  const style = each => getComputedStyle(each), root = document.documentElement;
  const text = [...document.querySelectorAll("body *")].filter(
    each => !each.closest("svg") && [...each.childNodes].some(one => one.nodeType == 3 && one.data.trim()));
  const ground = each => {
    for (; each; each = each.parentElement) {
      const of = style(each).backgroundColor;
      if (!of.startsWith("rgba")) return of;
    }
    return "";
  };
  const marked = name => [...document.querySelectorAll(name)].map(each => style(each).color);
  return {
    width: root.clientWidth, needed: root.scrollWidth, page: document.body.getBoundingClientRect().width,
    small: Math.min(...text.map(each => parseFloat(style(each).fontSize))),
    colors: [...new Set(text.map(each => style(each).color + ";" + ground(each)))],
    good: marked(".kept"), bad: marked(".broken, td.failed"),
    pictures: [...document.querySelectorAll("svg, img")].map(each => each.getBoundingClientRect().width),
    lost: [...document.querySelectorAll("a")].map(each => each.getAttribute("href")
        || each.getAttribute("xlink:href")).filter(to => to && !document.querySelector(to)),
  };
})()"""


def made_pages(folder: Path) -> Iterator[tuple[str, Path]]:
    """Name and place of one of each kind."""
    folder.mkdir()
    blackout = made.EXAMPLES / "blackout.toml"
    made.hil("run", str(blackout), "--record", str(folder / "run"), status=1)
    made.hil("review", str(folder / "run"), "--report", str(folder / "review.html"), status=1)
    yield "review", folder / "review.html"
    made.hil("run", str(made.EXAMPLES / "three_axes.toml"), "--record", str(folder / "three"))
    made.hil("review", str(folder / "three"), "--report", str(folder / "three.html"))
    yield "review-three-axes", folder / "three.html"
    made.hil("export", str(folder / "three"), "--to", "asc", "--out", str(folder / "log.asc"))
    log = ("--log", str(folder / "log.asc"), "--bench", str(made.EXAMPLES / "three_axes.toml"))
    made.hil("review", *log, "--report", str(folder / "log.html"))
    yield "log", folder / "log.html"
    commissioned = made.commissioning(folder / "commissioned")
    yield "commissioning", commissioned / "report.html"
    yield "certificate", commissioned / "certificate.html"
    with chdir(folder):
        campaign = made.campaign(folder / "campaign")
    yield "campaign", campaign / "report.html"


def look_at(pages: Iterator[tuple[str, Path]], out: Path) -> Iterator[tuple[str, list[str]]]:
    """Draw each as ``out``/page-NAME-WIDTH-THEME.png; yield the name and what is wrong with it."""
    with browser() as shown:
        for name, place in pages:
            for size in SIZES:
                for theme in GROUNDS:
                    shown.show(place.resolve().as_uri(), size, theme)
                    called = f"page-{name}-{size[0]}-{theme}"
                    yield called, _complaints(shown, theme, out / f"{called}.png")


def _complaints(shown: Browser, theme: str, place: Path) -> list[str]:
    png = shown.picture()
    place.write_bytes(png)
    told: dict[str, Any] = shown.evaluate(_PROBE)
    pixels = matplotlib.image.imread(io.BytesIO(png), format="png")[..., :3] * 255.0
    return [*_of_layout(told), *_of_colors(told), *_of_pixels(pixels, theme)]


def _of_layout(told: dict[str, Any]) -> Iterator[str]:
    if told["needed"] > told["width"]:
        yield f"{told['needed']} px wide on a screen of {told['width']}"
    if told["page"] < _NARROWEST * told["width"]:
        yield f"the page takes {told['page']:.0f} px of {told['width']}"
    if told["small"] < 12.0:
        yield f"text of {told['small']:g} px"
    for width in told["pictures"]:
        if width < 0.4 * told["page"]:
            yield f"a picture {width:.0f} px wide on a page of {told['page']:.0f}"
    for link in told["lost"]:
        yield f"a link to {link}, which is not there"


def _of_colors(told: dict[str, Any]) -> Iterator[str]:
    for pair in told["colors"]:
        ink, _, ground = pair.partition(";")
        if ground and contrast(_rgb(ink), _rgb(ground)) < _READABLE:
            yield f"text {ink} on {ground}"
    for good in set(told["good"]):
        for bad in set(told["bad"]):
            if apart(_rgb(good), _rgb(bad)) < _APART:
                yield f"{good} for what is kept and {bad} for what is broken"


def _of_pixels(pixels: NDArray[np.float64], theme: str) -> Iterator[str]:
    """The screen as it is seen: its ground in the corners, and ink on it."""
    ground = np.array(GROUNDS[theme])
    for corner in (pixels[0, 0], pixels[-1, 0], pixels[0, -1]):
        if np.abs(corner - ground).max() > 4.0:
            yield f"a {theme} page whose corner is {corner.round().tolist()}"
            break
    if (np.abs(pixels - ground).max(axis=2) > 60.0).mean() < 0.005:
        yield "blank"
    if (np.abs(pixels[:, [0, -1]] - ground).max(axis=2) > 60.0).any():
        yield "something runs into the edge of the screen"


def _rgb(color: str) -> tuple[float, ...]:
    """Of "rgb(1, 2, 3)"."""
    return tuple(float(each) for each in color[color.index("(") + 1 : -1].split(",")[:3])
