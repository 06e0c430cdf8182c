"""Chromium without a window, spoken to through two pipes (its DevTools protocol): what a reader of a page
sees of it on a screen of a size, light or dark."""

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock

PROGRAM: Final = shutil.which("chromium")
"""None: there is none on this machine, and pages are not looked at."""
_OPTIONS: Final = (
    *("--headless=new", "--no-sandbox", "--hide-scrollbars", "--remote-debugging-pipe"),
    *("--no-first-run", "--mute-audio"),
)
"""Scroll bars none: they are no part of a page's width."""
_FLAT, _WITH_GL = ("--disable-gpu",), ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Graphics by the processor; drawing a page of HTML by way of GL takes ten times as long."""
_ANSWER_MAX_NS: Final = 300 * NS_PER_S
"""A picture of 3840 x 2160 takes two minutes on a busy machine without a GPU."""


class Browser:
    """One page of it."""

    def __init__(self, asks: int, answers: int, zoom: float) -> None:
        """``asks``: a descriptor that commands are written to; ``answers``: that what it says comes from."""
        self._asks, self._answers = asks, answers
        self._zoom = zoom
        self._said = b""
        self._number = 0
        self._clock = MonotonicClock()
        self._session = ""
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._ask("Page.enable")

    def show(self, url: str, size: tuple[int, int], theme: str) -> None:
        """Open a page in a window of ``size``, px; ``theme``: light or dark, what the reader's system asks
        for."""
        width, height = (round(pixels / self._zoom) for pixels in size)
        # A scale of 0 leaves the one that the browser was begun with: another would be an emulated screen's,
        # for which the viewer draws its page twice too large.
        self._ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=0,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": theme}
        self._ask("Emulation.setEmulatedMedia", features=[scheme])
        self._ask("Page.navigate", url=url)
        while self.evaluate("document.readyState") != "complete":
            select.select([], [], [], 0.05)

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression, as JSON."""
        return self._ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def picture(self) -> bytes:
        """The window as PNG."""
        return base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"])

    def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        told: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            told["sessionId"] = self._session
        os.write(self._asks, json.dumps(told).encode() + b"\0")
        give_up = self._clock.now() + _ANSWER_MAX_NS
        while (answer := json.loads(self._next(give_up))).get("id") != self._number:
            pass
        assert "error" not in answer, (method, answer["error"])
        result: dict[str, Any] = answer["result"]
        return result

    def _next(self, give_up: int) -> bytes:
        while b"\0" not in self._said:
            assert self._clock.now() < give_up, "the browser does not answer"
            if select.select([self._answers], [], [], 1.0)[0]:
                told = os.read(self._answers, 1 << 20)
                assert told, "the browser has ended"
                self._said += told
        message, _, self._said = self._said.partition(b"\0")
        return message


@contextmanager
def browser(*, gl: bool = False, zoom: float = 1.0) -> Iterator[Browser]:
    """One that ends with the block; ``gl``: with WebGL, which the viewer in a browser draws by; ``zoom``:
    pixels of the screen for one of a page."""
    assert PROGRAM is not None, "no chromium: apt-get install chromium"
    reads, asks = os.pipe()
    answers, writes = os.pipe()
    options = *_OPTIONS, *(_WITH_GL if gl else _FLAT), f"--force-device-scale-factor={zoom:.6f}"
    with tempfile.TemporaryDirectory() as profile:
        # it reads from descriptor 3 and writes to 4, whatever they are here
        moved = f"exec 103<&{reads} 104>&{writes}; exec 3<&103 4>&104 103<&- 104>&-"
        process = subprocess.Popen(
            ["bash", "-c", f'{moved}; exec "$0" "$@"', PROGRAM, *options, f"--user-data-dir={profile}"],
            pass_fds=(reads, writes),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(reads)
        os.close(writes)
        try:
            yield Browser(asks, answers, zoom)
        finally:
            os.close(asks)
            os.close(answers)
            process.terminate()
            process.wait()
