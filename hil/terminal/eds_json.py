"""A data sheet as one JSON object."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from drivers.canopen.objects301 import MANUFACTURER
from drivers.canopen.pdo import PdoMap, mapping_text
from drivers.canopen.pdo_budget import Budget, content_of
from drivers.canopen.pdo_capability import PdoSlot
from drivers.sheets.dictionary import LoadedDictionary
from drivers.sheets.eds.sections import section_name
from drivers.sheets.fitness import FileIdentity, Fitness
from hil.terminal.eds_sheet import Planned, unit_lines


def sheet(file: Path, loaded: LoadedDictionary, fitness: Fitness, planned: Planned | None) -> dict[str, Any]:
    """What ``hil eds --json`` prints."""
    made: dict[str, Any] = {
        "file": str(file),
        "serves": fitness.serves,
        "obstacles": list(fitness.obstacles),
        "remarks": list(fitness.remarks),
        "kind": loaded.kind,
        "node_id": loaded.dictionary.node_id,
        "identity": _identity(fitness.identity),
        "profile": fitness.profile,
        "axes": fitness.axes,
        "modes": [mode.title for mode in fitness.modes],
        "modes_told_by": fitness.modes_told_by,
        "usable_modes": [
            {"mode": each.mode.title, "pdo_plan": each.plan is not None, "reason": each.reason}
            for each in fitness.usable
        ],
        "pdos": [_pdo(pdo) for pdo in fitness.pdos],
        "missing": [
            {"index": f"{lack.index:04X}h", "name": lack.name, "consequence": lack.consequence}
            for lack in fitness.lacks
        ],
        "units": [line._asdict() for line in unit_lines(loaded, fitness)[0]],
        "repairs": [repair._asdict() for repair in loaded.repairs],
        "objects": _counts(loaded),
        "file_information": asdict(loaded.file),
        "device_information": asdict(loaded.device),
        "commissioning": None if loaded.commissioning is None else asdict(loaded.commissioning),
        "denotations": {
            section_name(entry.index, entry.sub): entry.denotation
            for described in loaded.objects.values()
            for entry in described.entries.values()
            if entry.denotation
        },
    }
    if planned is not None:
        made["plan"] = _plan(planned)
    return made


def _identity(identity: FileIdentity) -> dict[str, Any]:
    numbers = {
        name: None if value is None else f"0x{value:08X}"
        for name, value in (
            ("vendor_id", identity.vendor),
            ("product_code", identity.product),
            ("revision", identity.revision),
            ("device_type", identity.device_type),
        )
    }
    texts = {
        "vendor_name": identity.vendor_name,
        "product_name": identity.product_name,
        "order_code": identity.order_code,
        "device_name": identity.device_name,
    }
    return {**texts, **numbers}


def _pdo(pdo: PdoSlot) -> dict[str, Any]:
    return {
        "name": pdo.name,
        "cob_id": None if pdo.identifier is None else f"0x{pdo.identifier:03X}",
        "valid": pdo.valid,
        "transmission_type": pdo.transmission_type,
        "inhibit_time_us": None if pdo.inhibit_time is None else pdo.inhibit_time * 100,
        "event_timer_ms": pdo.event_timer,
        "mapping": mapping_text(pdo.mapping).split(),
        "mapping_writable": pdo.mapping_writable,
        "entries_max": pdo.entries_max,
    }


def _counts(loaded: LoadedDictionary) -> dict[str, int]:
    indices = list(loaded.objects)
    return {
        "total": len(indices),
        "communication": sum(index < 0x2000 for index in indices),
        "manufacturer": sum(index in MANUFACTURER for index in indices),
        "profile": sum(index >= 0x6000 for index in indices),
        "entries": sum(len(described.entries) for described in loaded.objects.values()),
    }


def _plan(planned: Planned) -> dict[str, Any]:
    if planned.result is None or planned.budget is None:
        return {"mode": planned.mode, "possible": False, "reason": planned.reason}
    plan = planned.result.plan
    return {
        "mode": planned.mode,
        "possible": True,
        "notes": list(planned.result.notes),
        "pdos": [_mapped(pdo) for pdo in plan],
        "budget": _budget(planned.budget),
    }


def _mapped(pdo: PdoMap) -> dict[str, Any]:
    return {
        "name": pdo.name,
        "cob_id": f"0x{pdo.cob_id:03X}",
        "transmission_type": pdo.transmission_type,
        "mapping": content_of(pdo).split(),
        "bits": pdo.bits,
    }


def _budget(budget: Budget) -> dict[str, Any]:
    return {
        "period_us": budget.period_ns / 1e3,
        "bitrate_bit_s": budget.bitrate_bit_s,
        "frames": [
            {
                "name": line.name,
                "cob_id": f"0x{line.cob_id:03X}",
                "data_bytes": line.data_bytes,
                "bits_max": line.bits_max,
                "time_us": line.time_ns / 1e3,
                "a_cycle": line.a_cycle,
            }
            for line in budget.lines
        ],
        "busy_us": budget.busy_ns / 1e3,
        "load_percent": budget.load_percent,
        "fullest_cycle_percent": budget.fullest_cycle_percent,
        "shortest_period_us": budget.shortest_period_ns / 1e3,
        "sdo_transfers_a_s": budget.sdo_transfers_a_s,
    }
