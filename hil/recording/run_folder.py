"""What the files in a run's folder are called; for readers too, who need no writer for that."""

FRAMES_FILE = "frames.log"
"""Every frame, in candump's format."""
EVENTS_FILE = "events.jsonl"
LOAD_FILE = "load.csv"
"""What a load machine measured."""
