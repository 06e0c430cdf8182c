"""What the files in a run's folder are called; for readers too, who need no writer for that."""

FRAMES_FILE = "frames.log"
"""Every frame, in candump's format and in order of time."""
DIRECTIONS_FILE = "frames.directions"
"""A line for each of frames.log: T was sent by the bench, R was received by it."""
EVENTS_FILE = "events.jsonl"
LOAD_FILE = "load.csv"
"""What a load machine measured."""
