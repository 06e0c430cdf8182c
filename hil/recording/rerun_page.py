"""What every page of Rerun is framed by, and the file that it goes into."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import rerun as rr
import rerun.blueprint as rrb

from hil.recording.page_series import TIMELINE


def framed(content: rrb.Container, timeline: str = TIMELINE, *, follows: bool = False) -> rrb.Blueprint:
    """A page of ``content`` alone; ``follows``: its cursor goes with what still comes."""
    return rrb.Blueprint(
        content,
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following" if follows else "paused"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


@contextmanager
def stream_into(path: Path, application: str) -> Iterator[rr.RecordingStream]:
    """A stream whose file is whole at the end of the block. Error: OSError."""
    stream = rr.RecordingStream(application, recording_id=uuid4().hex)
    try:
        stream.set_sinks(rr.FileSink(path))
    except (RuntimeError, ValueError) as error:
        raise OSError(str(error)) from error
    yield stream
    stream.flush(timeout_sec=60.0)
    stream.disconnect()
