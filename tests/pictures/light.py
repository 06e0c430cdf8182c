"""The viewer on light ground: what ``hil view --serve`` shows in a browser; without a window it is dark."""

import select
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.recorded.viewer import LAID_OUT_FOR, page_file
from servobench.hil.recording.serving import choose_ports, comes_to_listen, serve_file
from tests.pictures.browser import Browser, browser
from tests.pictures.pixels import BARS, LIGHT, Picture

_PAGE_MAX_NS: Final = 600 * NS_PER_S
"""The viewer is 40 MB of code, which the browser compiles in a minute on a busy machine without a
GPU; then it draws a screen of 3840 x 2160 in some more."""
_POLL_S: Final = 1.0
_LANES_PX: Final = 300
"""So wide are the bars of a page together; what is selected in the viewer's own panel is less."""


def light_pages(recording: Path, sizes: tuple[tuple[int, int], ...]) -> Iterator[bytes]:
    """The page that a recording opens with, on light ground, in windows of these sizes, which are zoomed."""
    with _served(page_file(recording)) as url:
        for size in sizes:
            with browser(gl=True, zoom=size[0] / LAID_OUT_FOR[0]) as shown:
                shown.show(f"{url}&theme=light", size, "light")
                yield _settled(shown)


def _settled(shown: Browser) -> bytes:
    """The window when it has lanes, and does not change any more; what there is of it after a while."""
    clock = MonotonicClock()
    give_up, last = clock.now() + _PAGE_MAX_NS, b""
    while clock.now() < give_up:
        select.select([], [], [], _POLL_S)
        png = shown.picture()
        picture = Picture.of_png(png, LIGHT)
        if png == last and sum(map(picture.bar_px, BARS.values())) > _LANES_PX:
            break
        last = png
    return last


@contextmanager
def _served(page: Path) -> Iterator[str]:
    ports = choose_ports()
    process = serve_file(ports, page)
    try:
        assert all(comes_to_listen(process, port) for port in ports), "nothing is served"
        yield ports.page_url
    finally:
        process.kill()
        process.communicate()


SIZES: Final = (LAID_OUT_FOR, (1366, 768), (3840, 2160))
