"""Which recorder a run has."""

from hil.recording.memory_recorder import MemoryRecorder
from hil.recording.recorder import start_recording
from hil.recording.run_recorder import RunRecorder
from hil.rows.recording_plan import RecordingPlan


def recorder_of(plan: RecordingPlan) -> RunRecorder:
    """Files are another process's business, and in real time the figures, too, which the loop would feel."""
    if plan.folder is None and not plan.view and not plan.real_time:
        return MemoryRecorder(plan)
    return start_recording(plan)
