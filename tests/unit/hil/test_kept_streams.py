"""A standard stream of a command takes what is written to it until the process ends."""

import io
import os

from servobench.hil.machine.parent_process import KeptBuffer, StreamEnd


def test_a_stream_that_was_closed_is_written_to_and_closed_again() -> None:
    read, write = os.pipe()
    stream = io.TextIOWrapper(KeptBuffer(StreamEnd(write, on_terminal=False)), "utf-8")
    stream.write("before, ")
    stream.close()
    stream.write("after")
    stream.close()
    os.close(write)
    with os.fdopen(read) as told:
        assert told.read() == "before, after"
