"""What a Rerun recording holds, by Rerun's own reader."""

from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from servobench.hil.recording.lanes import STATES
from servobench.hil.recording.wide_rows import COMPONENT, cycles_entity, field_of

Column = tuple[np.ndarray, list[list[object]]]


def columns(path: Path, entity: str, component: str) -> Column:
    """Times (ns; 0 for static) and values of one component, in order of time."""
    times: list[int] = []
    values: list[list[object]] = []
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) != entity:
            continue
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        values += batch.column(component).to_pylist()
        static = "run_time" not in batch.schema.names
        times += [0] * batch.num_rows if static else batch.column("run_time").cast("int64").to_pylist()
    order = np.argsort(times, kind="stable")
    return np.array(times)[order], [values[place] for place in order]


def numbers(path: Path, entity: str) -> tuple[np.ndarray, np.ndarray]:
    """Times and scalars; (n,) or (n, series). Points without a value are left out.

    ``entity``: of the line, or of a line of the cycles as "/axis1/speed/measured".
    """
    times, found = line(path, entity)
    kept = ~np.isnan(found) if found.ndim == 1 else np.ones(len(times), bool)
    return times[kept], found[kept]


def line(path: Path, entity: str) -> tuple[np.ndarray, np.ndarray]:
    """The same with the points that have no value."""
    times, values = columns(path, entity, "Scalars:scalars")
    if values:
        found = np.array(values, np.float64)
        return times, np.squeeze(found, axis=1) if found.shape[1] == 1 else found
    axis, below = entity.strip("/").split("/", 1)
    times, values = columns(path, cycles_entity(axis), COMPONENT)
    field = field_of(below)
    return times, np.array([row[field] for (row,) in values], np.float64)  # type: ignore[index]


def lane(path: Path, track: str) -> Column:
    """Times and labels of a lane, as "axis1 dropouts"."""
    times, labels = columns(path, STATES, track)
    told = [place for place, label in enumerate(labels) if label and label[0] is not None]
    return times[told], [labels[place] for place in told]


def view_ranges(path: Path) -> list[tuple[int, int]]:
    """Absolute ones, ns, of all views of the last layout."""
    reader = RrdReader(path)
    found = []
    for store in reader.blueprints():
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            if "TimeAxis:view_range" in batch.schema.names:
                for (window,) in batch.column("TimeAxis:view_range").to_pylist():
                    found.append((window["start"], window["end"]))
    return [window for window in found if all(isinstance(end, int) for end in window)]
