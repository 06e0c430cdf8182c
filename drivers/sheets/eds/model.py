"""Objects of a file as the object dictionary of python canopen."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, cast

import canopen.objectdictionary as od

from servobench.drivers.canopen.cob_ids import EXTENDED, NO_RTR, NOT_VALID
from servobench.drivers.sheets.eds import types
from servobench.drivers.sheets.eds.entries import Entry
from servobench.drivers.sheets.eds.information import Commissioning, DeviceInformation
from servobench.drivers.sheets.eds.numbers import Formula
from servobench.drivers.sheets.eds.objects import EdsObject
from servobench.drivers.sheets.eds.values import Scalar

_FLAGS = NOT_VALID | NO_RTR | EXTENDED


def to_canopen(
    objects: Mapping[int, EdsObject],
    dummies: Iterable[int],
    device: DeviceInformation,
    commissioning: Commissioning | None,
    node_id: int | None,
) -> od.ObjectDictionary:
    """Build the dictionary; ``node_id`` replaces $NODEID; without it, a value that needs it is None."""
    dictionary = od.ObjectDictionary()  # type: ignore[no-untyped-call]
    dictionary.node_id = node_id
    if commissioning is not None and commissioning.bit_rate_kbit_s:
        dictionary.bitrate = commissioning.bit_rate_kbit_s * 1000
    _describe(dictionary, device)
    for number in dummies:
        dummy = od.ODVariable(f"Dummy{number:04d}", number, 0)
        dummy.data_type, dummy.access_type = number, "const"
        dictionary.add_object(dummy)
    configured_for = commissioning.node_id if commissioning is not None else None
    for index in sorted(objects):
        dictionary.add_object(_object(objects[index], node_id, configured_for))
    return dictionary


def _describe(dictionary: od.ObjectDictionary, device: DeviceInformation) -> None:
    information: Any = dictionary.device_information
    information.vendor_name, information.vendor_number = device.vendor_name, device.vendor_number
    information.product_name, information.product_number = device.product_name, device.product_number
    information.revision_number, information.order_code = device.revision_number, device.order_code
    information.nr_of_RXPDO, information.nr_of_TXPDO = device.receive_pdos, device.transmit_pdos
    information.granularity = device.granularity
    information.LSS_supported = device.lss_supported
    information.simple_boot_up_slave = device.simple_boot_up_slave
    information.allowed_baudrates.update(rate * 1000 for rate in device.bit_rates_kbit_s)


def _object(
    defined: EdsObject, node_id: int | None, configured_for: int | None
) -> od.ODVariable | od.ODArray | od.ODRecord:
    if defined.is_variable:
        return _variable(defined.entries[0], node_id, configured_for)
    kind = od.ODArray if defined.object_type == types.ARRAY else od.ODRecord
    parent: Any = kind(defined.name, defined.index)
    parent.storage_location = defined.storage
    for entry in defined.entries.values():
        parent.add_member(_variable(entry, node_id, configured_for))
    return cast(od.ODArray | od.ODRecord, parent)


def _variable(entry: Entry, node_id: int | None, configured_for: int | None) -> od.ODVariable:
    variable: Any = od.ODVariable(entry.name, entry.index, entry.sub)
    variable.data_type, variable.access_type = entry.data_type, entry.access
    variable.pdo_mappable, variable.storage_location = entry.mappable, entry.storage
    variable.min, variable.max = _limit(entry.low), _limit(entry.high)
    variable.default = entry.default.at(node_id)
    variable.value = entry.configured.at(node_id)
    followed = _followed(entry, configured_for)
    variable.relative = followed is not None
    if followed is not None and variable.value is not None and node_id is not None:
        variable.value = followed.at(node_id)
    if entry.default.text:
        variable.default_raw = entry.default.text
    if entry.configured.text:
        variable.value_raw = entry.configured.text
    variable.unit = entry.extras.get("Unit", "")
    variable.description = entry.extras.get("Description", "")
    with suppress(ValueError):
        variable.factor = float(entry.extras.get("Factor", "1"))
    return cast(od.ODVariable, variable)


def _followed(entry: Entry, configured_for: int | None) -> Formula | None:
    """Return the formula of a value: that of the parameter value if there is one, else the default's.

    Tools write the parameter values of a DCF as plain numbers. One that is the default's identifier on the
    node of the DCF, be it with other flags (bits 29 to 31), goes on following the node-ID.
    """
    configured, default = entry.configured, entry.default.formula
    if configured.formula is not None:
        return configured.formula if configured.formula.factor == 1 else None
    if default is None or default.factor != 1 or configured.value is None:
        return default if default is not None and default.factor == 1 else None
    if configured_for is None or not isinstance(configured.value, int):
        return None
    base = configured.value - configured_for
    return Formula(1, base) if not (base ^ default.base) & ~_FLAGS else None


def _limit(value: Scalar | None) -> int | float | None:
    return value if isinstance(value, int | float) else None
