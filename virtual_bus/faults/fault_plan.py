"""A fault plan: the faults of one bus and of the nodes on it, from a TOML file.

    [[loss]]            probability
    [[burst]]           p_good_to_bad, p_bad_to_good, loss_bad = 1, loss_good = 0
    [[periodic_loss]]   lost
    [[blackout]]        duration_s or until_s, or count
    [[delay]]           delay_us, or delay_min_us and delay_max_us; reorder = false
    [[measured_delay]]  edges_us and counts, or file; reorder = false
    [[reorder]]         probability; held_us, or held_min_us and held_max_us
    [[duplicate]]       probability, later_us = 0
    [[corruption]]      probability, effect = "error_frame", "lost" or "data"

Each of these may also hold direction ("host_to_drive", "drive_to_host"; "both" if left out), frames
(["pdo"] if left out), nodes, from_s, until_s and side ("host", "drive").

    [[signal]]          object = "velocity_actual_value", "606C", "60C1:1"; probability = 1;
                        how = "stuck" (stuck_raw), "offset" (offset_raw), "drift" (drift_raw_per_s),
                        "noise" (noise_raw_rms), "scale" (factor), "sign" or "bits" (set_bits, cleared_bits)

This one the same, but for frames: PDOs, wherever one carries the object.

    [[silence]]      duration_s                                      when
    [[bus_off]]      recover_after_s (never, if left out)            when
    [[drive_fault]]  fault = "over_current", "over_temperature",     when
                     "following_error", "encoder_loss" or "under_voltage";
                     of encoder_loss: detected_after_ms = 2, duration_s = 0.1
    [[safe_torque_off]]  duration_s                                  when
    [[supply_sag]]   to_percent, duration_s                          when
    [[chopper_off]]  duration_s                                      when
    [[dragging_brake]]  torque_nm, duration_s                        when
    [[loose_coupling]]  stiffness_percent, backlash_rad, duration_s  when
    [[dirty_encoder]]   from_deg, to_deg, duration_s                 when
    [[hot_motor]]    winding_c, magnet_c, duration_s                 when
    [[clock_step]]   step_us, or step_min_us and step_max_us         when
    [[clock_drift]]  drift_ppm; from_s, until_s
    [[slow_drive]]   sdo_delay_us, tpdo_delay_us, boot_s, or a _min and _max of each
    [[lss_yes_sayer]]
    [[mode_change]]  mode = "pp", "vl", "pv", "pt", "hm", "ip",      when
                     "csp", "csv" or "cst"; duration_s (for good, if left out)
    [[ignored_commands]]  holds = "last" or "zero",                  when
                     bit_12_cleared = true; duration_s
    [[refused_mapping]]  parameter = "1A00:1", mapped = "6061" or both;
                     abort = 0x06040041
    [[repeated_emergency]]  code, period_ms = 10; duration_s         when
    [[host_stall]]   late_us, or late_min_us and late_max_us         when
    [[full_queue]]   duration_s: the host's adapter takes no frames  when
    [[link_down]]    duration_s: its interface is down               when
    [[receive_overflow]]  duration_s: its kernel drops what comes    when

``when``: at_s, or every_s or probability_per_s with from_s and until_s. Each but the host's may hold nodes.

A plan says nothing about chance: the seed belongs to :class:`.fault_injector.FaultInjector`.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from servobench.drivers.errors import MISSING, BadInput
from servobench.drivers.key_advice import unknown_key
from servobench.drivers.timebase import NS_PER_S, Duration
from servobench.virtual_bus.faults.fault_table import A_NUMBER, A_WHOLE_NUMBER, FaultTable
from servobench.virtual_bus.faults.frame_fault import FrameFault, LinkFault, Side
from servobench.virtual_bus.faults.kinds.host_stall import HostStall
from servobench.virtual_bus.faults.kinds.signal import SignalFault
from servobench.virtual_bus.faults.node_fault import AdapterOutage, NodeFault
from servobench.virtual_bus.faults.register import TABLES

_EXPECTED = {
    "float_type": A_NUMBER,
    "finite_number": A_NUMBER,
    "int_type": A_WHOLE_NUMBER,
    "int_from_float": A_WHOLE_NUMBER,
    "bool_type": "true or false",
    "string_type": "text in quotes",
}
"""Accepted values of a field, by the validator's code of the error."""
_MISSING: dict[Any, str] = {float: "float_type", int: "int_type"}
"""That word, by the type of a field that has no value."""


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """All faults of one bus, and of the nodes on it.

    A frame is lost if any fault loses it. Of corruption, duplication and reordering only the first of them,
    in this order, strikes a frame; delays act on whatever passes.
    """

    faults: tuple[FrameFault, ...] = ()
    node_faults: tuple[NodeFault, ...] = ()
    host_stalls: tuple[HostStall, ...] = ()
    signals: tuple[SignalFault, ...] = ()
    outages: tuple[AdapterOutage, ...] = ()

    @property
    def sides(self) -> list[tuple[str, Side]]:
        """The kinds of the faults of frames and signals that name a side, and that side."""
        return [(fault.kind, fault.side) for fault in self._on_links if fault.side is not None]

    def at(self, side: Side) -> "FaultPlan":
        """Return the faults of frames at the connection of the program with the plan: ``side``'s."""
        return _of_links(fault for fault in self._on_links if fault.side in (None, side))

    def at_drive(self, node: int) -> "FaultPlan":
        """Return the faults of frames at the connection of that one drive."""
        return _of_links(
            fault.model_copy(update={"nodes": (node,)})
            for fault in self._on_links
            if fault.side == "drive" and node in (fault.nodes or (node,))
        )

    @property
    def _on_links(self) -> tuple[LinkFault, ...]:
        return *self.faults, *self.signals

    @property
    def _tables(self) -> tuple[FaultTable, ...]:
        return *self._on_links, *self.node_faults, *self.host_stalls, *self.outages

    def idle(
        self, nodes: Set[int], duration: Duration, parts: Mapping[int, Set[str]]
    ) -> Iterator[tuple[str, str]]:
        """Yield each table that never acts in a run of ``duration``, ns, on a bus with ``nodes``: its key in
        the file, and why. ``parts``: of the simulated drives."""
        counts = Counter[str]()
        for fault in self._tables:
            place = f"{fault.kind}[{counts[fault.kind]}]"
            counts[fault.kind] += 1
            named, edges = getattr(fault, "nodes", ()), fault.edges_ns
            if named and nodes.isdisjoint(named):
                told = ", ".join(str(node) for node in sorted(named))
                yield f"{place}.nodes", f"{told}: the bench has none of them, so it never acts"
            elif edges and min(edges) >= duration:
                yield place, f"it begins at {min(edges) / NS_PER_S:g} s, behind the end, so it never acts"
            elif (part := getattr(fault, "needs_part", "")) and not any(
                part in parts.get(node, ()) for node in named or parts
            ):
                yield place, f"no drive that it strikes has [{part}], so it never acts"

    def as_tables(self) -> dict[str, list[dict[str, Any]]]:
        """The plan as :func:`load_fault_plan` takes it, to be written beside a run."""
        tables: dict[str, list[dict[str, Any]]] = {}
        for fault in self._tables:
            tables.setdefault(fault.kind, []).append(fault.as_table())
        return tables


def load_fault_plan(mapping: Mapping[str, Any], source: str, prefix: str = "") -> FaultPlan:
    """The plan in ``mapping``, read from the file ``source`` (there under the table ``prefix``).

    Raises :class:`BadInput`, the first of what :func:`read_fault_plan` finds.
    """
    plan, errors = read_fault_plan(mapping, source, prefix)
    if errors:
        raise errors[0]
    return plan


def read_fault_plan(
    mapping: Mapping[str, Any], source: str, prefix: str = ""
) -> tuple[FaultPlan, list[BadInput]]:
    """Read a plan like :func:`load_fault_plan`, but return all errors; the plan then holds the readable
    faults."""
    faults: list[FaultTable] = []
    errors: list[BadInput] = []
    for kind, tables in mapping.items():
        path = f"{prefix}.{kind}" if prefix else kind
        if kind not in TABLES:
            errors.append(unknown_key(source, path, _short(tables), tuple(TABLES)))
        elif not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
            errors.append(
                BadInput(source, path, _short(tables), f"an array of tables, each headed [[{path}]]")
            )
        else:
            for index, table in enumerate(tables):
                try:
                    faults.append(TABLES[kind].model_validate(dict(table), context={"source": source}))
                except ValidationError as error:
                    errors += _bad_inputs(error, TABLES[kind], source, f"{path}[{index}]")
                except BadInput as error:
                    key = f"{path}[{index}].{error.key}"
                    errors.append(BadInput(source, key, _short(error.value), error.expected, error.remedy))
    plan = FaultPlan(
        tuple(fault for fault in faults if isinstance(fault, FrameFault)),
        tuple(fault for fault in faults if isinstance(fault, NodeFault)),
        tuple(fault for fault in faults if isinstance(fault, HostStall)),
        tuple(fault for fault in faults if isinstance(fault, SignalFault)),
        tuple(fault for fault in faults if isinstance(fault, AdapterOutage)),
    )
    return plan, errors


def _of_links(faults: Iterable[LinkFault]) -> FaultPlan:
    every = tuple(faults)
    frames = tuple(fault for fault in every if isinstance(fault, FrameFault))
    return FaultPlan(frames, signals=tuple(fault for fault in every if isinstance(fault, SignalFault)))


def _bad_inputs(
    error: ValidationError, model: type[FaultTable], source: str, path: str
) -> Iterator[BadInput]:
    """Return the faults of a table; for unknown keys only those, as they may be misspelt known ones."""
    details = error.errors(include_url=False)
    # Its own keys before the shared ones: they are likelier to be meant.
    known = [key for base in model.__mro__ for key in vars(base).get("__annotations__", ())]
    known = [key for key in known if key in model.model_fields]
    unknown = [detail for detail in details if detail["type"] == "extra_forbidden"]
    for detail in unknown:
        yield unknown_key(source, f"{path}.{detail['loc'][0]}", _short(detail["input"]), known)
    for detail in () if unknown else details:
        name = str(detail["loc"][0])
        value = MISSING if detail["type"] == "missing" else _short(detail["input"])
        yield BadInput(source, f"{path}.{name}", value, _expected(detail, model, name))


def _expected(detail: ErrorDetails, model: type[FaultTable], name: str) -> str:
    kind, field = detail["type"], model.model_fields[name]
    if kind == "value_error":
        return detail["msg"].removeprefix("Value error, ")
    if field.description:
        return field.description
    if kind == "literal_error":
        words = tuple(re.findall(r"'(\w+)'", detail["ctx"]["expected"]))
        return f"one of {', '.join(words)}"
    if kind == "missing":
        words = get_args(field.annotation)
        return f"one of {', '.join(words)}" if words else _EXPECTED[_MISSING[field.annotation]]
    return _EXPECTED.get(kind, detail["msg"])


def _short(value: Any) -> Any:
    """``value``, or a word for what would not fit into a line."""
    if isinstance(value, Mapping):
        return "a table"
    return "a list" if isinstance(value, list) and len(repr(value)) > 60 else value
