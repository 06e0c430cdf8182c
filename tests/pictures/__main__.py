"""``python -m tests.pictures``: all of them into a folder, with an index.html to look at them side by side.

Leaves with 1 if one does not show what it has to.
"""

import argparse
import html
import tempfile
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.recorded.viewer import headless_viewer, page_file
from tests.pictures.browser import PROGRAM
from tests.pictures.cases import Case, cases
from tests.pictures.html_pages import look_at, made_pages
from tests.pictures.light import SIZES, light_pages
from tests.pictures.pixels import DARK, LIGHT, Color, Picture, complaints
from tests.pictures.window import bursts_of, look_into

_VIEWERS: Final = 3
"""At once: one mostly waits for the notice with which it opens to go."""
_STYLE: Final = (
    "body{font:14px sans-serif;background:#222;color:#ddd}figure{display:inline-block;width:31%;margin:.5%}"
    "img{width:100%}.wrong{color:#f66}"
)

Drawn = tuple[str, list[str]]
"""Name of a picture, and what is wrong with it."""


def draw(case: Case, recording: Path, out: Path) -> list[Drawn]:
    """What a user sees on opening it, and the other pages, as ``out``/NAME.png, ``out``/NAME-PAGE.png,
    ``out``/NAME-window.png, ``out``/NAME-WIDTH.png and ``out``/NAME-WIDTH-light.png."""
    with headless_viewer() as viewer:
        viewer.show(page_file(recording))
        viewer.put_cursor(None)
        drawn = [_judged(case.name, viewer.picture(), out, case)]
        for page in viewer.pages()[1:] if case.pages else ():
            viewer.turn_to(page)
            drawn.append(_judged(f"{case.name}-{page.replace('/', '-')}", viewer.picture(), out, None))
        if case.window:
            png, wrong = look_into(viewer, bursts_of(recording))
            (out / f"{case.name}-window.png").write_bytes(png)
            drawn.append((f"{case.name}-window", wrong))
    for size in SIZES[1:] if case.sizes else ():
        with headless_viewer(size) as viewer:
            viewer.show(page_file(recording))
            viewer.put_cursor(None)
            drawn.append(_judged(f"{case.name}-{size[0]}", viewer.picture(), out, case))
    if case.light and PROGRAM is not None:
        sizes = SIZES if case.sizes else SIZES[:1]
        for size, png in zip(sizes, light_pages(recording, sizes), strict=True):
            drawn.append(_judged(f"{case.name}-{size[0]}-light", png, out, case, LIGHT))
    return drawn


def _judged(name: str, png: bytes, out: Path, case: Case | None, ground: Color = DARK) -> Drawn:
    (out / f"{name}.png").write_bytes(png)
    picture = Picture.of_png(png, ground)
    return name, complaints(picture, case.lines, case.seen) if case else complaints(picture, (), {})


def _drawn(case: Case, future: Future[list[Drawn]]) -> list[Drawn]:
    try:
        return future.result()
    except AssertionError as error:  # a browser that does not answer does not take the others with it
        return [(case.name, [str(error)])]


def write_index(drawn: Sequence[Drawn], out: Path) -> None:
    """The contact sheet."""
    figures = [
        f'<figure><a href="{name}.png"><img src="{name}.png" loading="lazy"></a><figcaption>{name} '
        f'<span class="wrong">{html.escape("; ".join(wrong))}</span></figcaption></figure>'
        for name, wrong in drawn
    ]
    page = f"<!doctype html><meta charset=utf-8><title>Pictures</title><style>{_STYLE}</style>"
    (out / "index.html").write_text(page + "\n".join(figures) + "\n", encoding="utf-8")


def main() -> None:
    """Draw them, and say of each what is wrong with it."""
    parser = argparse.ArgumentParser(prog="python -m tests.pictures", description=__doc__)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--out", type=Path, default=Path("build/pictures"))
    parser.add_argument("--only", default="", help="those whose names have this in them")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    clock = MonotonicClock()
    ends_at = clock.now() + options.seconds * NS_PER_S
    chosen = [case for case in cases() if options.only in case.name]
    pending: list[Future[list[Drawn]]] = []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(_VIEWERS) as viewers:
        for case in chosen:
            if clock.now() > ends_at:
                break
            recording = case.make(Path(folder) / case.name)
            pending.append(viewers.submit(draw, case, recording, options.out))
        drawn = [each for case, future in zip(chosen, pending, strict=False) for each in _drawn(case, future)]
        if PROGRAM is None:
            print("pages of HTML and light pages are not looked at: no chromium; apt-get install chromium")
        elif options.only in "page":
            drawn += look_at(made_pages(Path(folder) / "pages"), options.out)
    write_index(drawn, options.out)
    for name, wrong in drawn:
        if wrong:
            print(f"{name}: {'; '.join(wrong)}", flush=True)
    broken = sum(bool(wrong) for _, wrong in drawn)
    print(
        f"{len(drawn)} pictures of {len(pending)} of {len(chosen)} recordings, {broken} not as they should be"
    )
    print(options.out / "index.html")
    raise SystemExit(broken > 0)


if __name__ == "__main__":
    main()
