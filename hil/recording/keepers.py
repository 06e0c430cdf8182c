"""Keepers of a run, as its plan asks for them."""

from servobench.hil.machine.extras import is_installed
from servobench.hil.recording.log_files import (
    EventsKeeper,
    FramesKeeper,
    Keeper,
    LoadKeeper,
    NetworkKeeper,
    RecordsKeeper,
)
from servobench.hil.reviewing.review import Review
from servobench.hil.rows.recording_plan import RecordingPlan


def open_keepers(plan: RecordingPlan, review: Review) -> list[Keeper]:
    """Everything that the plan asks for; nothing without a folder.

    ``review``: of the run, for its pages.
    """
    if plan.folder is None:
        return []
    keepers: list[Keeper] = [
        RecordsKeeper(plan, plan.folder),
        EventsKeeper(plan, plan.folder),
        LoadKeeper(plan, plan.folder),
    ]
    if plan.frames:
        keepers.append(FramesKeeper(plan, plan.folder))
    if plan.period_us:
        keepers.append(NetworkKeeper(plan.folder, review))
    # last, so that on a full disk what is kept for the end is not Rerun's
    if is_installed("rerun"):
        from servobench.hil.recording.page_keepers import open_pages

        keepers += open_pages(plan, plan.folder, review)
    return keepers
