"""A replay as a page for Rerun: each difference between what is allowed of it."""

from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.recording.page_series import BLUE, GREY
from servobench.hil.recording.rerun_page import framed, from_zero, plot, send_line, stream_into
from servobench.hil.twin.replay import OUTPUTS, Replay

_APPLICATION: Final = "servobench replay"


def write_replay(found: Replay, markdown: str, path: Path) -> None:
    """``markdown``: what is told beside the plots. Error: OSError."""
    times = np.array([end for window in found.windows for end in (window.begin_ns, window.end_ns)], np.int64)
    views = []
    with stream_into(path, _APPLICATION) as stream:
        for place, (name, unit) in enumerate(OUTPUTS):
            each = [(window.speed, window.position, window.torque)[place] for window in found.windows]
            lines = {
                "difference": (np.repeat([one.difference for one in each], 2), BLUE),
                "allowed": (np.repeat([one.allowed for one in each], 2), GREY),
            }
            for line, (values, color) in lines.items():
                send_line(stream, f"/{found.axis}/{name}/{line}", (times, values), line, color)
            axis_x = from_zero(float(times[-1]) / NS_PER_S)
            contents = [f"+ /{found.axis}/{name}/{line}" for line in lines]
            views.append(plot("/", contents, f"{name} beside the twin, rms [{unit}]", axis_x, legend=True))
        stream.log("/differences", rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN), static=True)
        text = rrb.TextDocumentView(origin="/differences", name="Differences")
        stream.send_blueprint(framed(rrb.Horizontal(rrb.Vertical(*views), text, column_shares=[6, 4])))
