"""Files of a simulated device on the command line: its data sheet and its memory."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.quirky_units import apply_quirks
from servobench.drivers.cia402.scaling import ENCODER_COUNTS_MIN, FACTOR_OBJECTS, ScaleOverride
from servobench.drivers.errors import BadInput
from servobench.drivers.sheets.dictionary import held, load_dictionary, told_identity
from servobench.drivers.sheets.eds.information import Commissioning
from servobench.drivers.vendors.families import quirks_for
from servobench.drivers.written_file import write_file
from servobench.virtual_bus.device.communication_objects import export_eds
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.parameter_storage import FileStore
from servobench.virtual_bus.device.vendor_dictionary import BASE_NODE_ID
from servobench.virtual_bus.drive.data_sheet import lay_over, tell_motor
from servobench.virtual_bus.drive.servo_parameters import DriveParameters

Maker = Callable[[ObjectDictionary], None]
"""Turns a simulated device's dictionary into that of a data sheet, or its own."""
REPAIRS_SHOWN = 5
"""Repairs shown; the others are counted."""
_SERIAL_NUMBER = 4
"""Sub-index of 1018h."""


class DeviceFiles(NamedTuple):
    """Files from which a device is made, besides motor and faults."""

    eds: Path | None = None
    """EDS or DCF (CiA 306-1), XDD or XDC (CiA 311) that defines the objects on the bus."""
    store: Path | None = None
    """File to which 1010h and LSS store, beyond the end of the process."""
    export: Path | None = None
    """File for the device's own EDS."""

    def commissioned_node(self) -> int | None:
        """Return the node-ID that a DCF was made for; None if there is none. Raises BadInput."""
        if self.eds is None:
            return None
        commissioning = load_dictionary(self.eds).commissioning
        return None if commissioning is None else commissioning.node_id

    def drive(self, parameters: DriveParameters) -> DriveParameters:
        """Return ``parameters`` with the units of the sheet's maker, and the encoder that the sheet defines
        by an object of the maker's, if it does: a master that knows the maker takes the units from there.
        Raises BadInput."""
        if self.eds is None:
            return parameters
        loaded = load_dictionary(self.eds, BASE_NODE_ID)
        told, resolution = told_identity(loaded.dictionary), (Object.POSITION_ENCODER_RESOLUTION, 1)

        def read(index: int, sub: int) -> int | None:
            value = held(loaded.dictionary, index, sub)
            return value if isinstance(value, int) else None

        vendor, product = (next(iter(numbers), 0) for numbers in (told.vendor, told.product))
        name = held(loaded.dictionary, Cia301.DEVICE_NAME)
        named = name if isinstance(name, str) and name else loaded.device.product_name
        quirks = quirks_for(vendor, product, named)
        parameters = replace(parameters, makers_units=quirks)
        known = apply_quirks(quirks, {key: read(*key) for key in FACTOR_OBJECTS}, ScaleOverride(), read)
        counts = known.values.get(resolution) or 0
        if read(*resolution) or counts < ENCODER_COUNTS_MIN:
            return parameters
        return replace(parameters, encoder_counts_per_revolution=counts)

    def vendor(
        self,
        announce: Callable[[str], None],
        nodes: Sequence[int] = (),
        bitrate_bit_s: int | None = None,
        motor: PmsmParameters | None = None,
    ) -> Maker | None:
        """Return the function that lays the data sheet over a device's dictionary; ``announce`` receives the
        repairs, and differences between a DCF and ``nodes`` or ``bitrate_bit_s``. ``motor``: the one
        described by objects of the sheet's maker.

        Raises BadInput if the file cannot be read.
        """
        if self.eds is None:
            return None
        loaded = load_dictionary(self.eds, BASE_NODE_ID)
        commissioning = loaded.commissioning or Commissioning()
        for difference in _differences(commissioning, nodes, bitrate_bit_s):
            announce(f"{self.eds}: {difference}")
        for repair in loaded.repairs[:REPAIRS_SHOWN]:
            announce(f"{self.eds}: {repair}")
        if len(loaded.repairs) > REPAIRS_SHOWN:
            announce(f"{self.eds}: and {len(loaded.repairs) - REPAIRS_SHOWN} more repairs of that kind")

        def lay(dictionary: ObjectDictionary) -> None:
            lay_over(dictionary, loaded.dictionary)
            if motor is not None:
                tell_motor(dictionary, motor)
            _number(dictionary, commissioning.serial_number)  # LSS_SerialNumber, CiA 306-1

        return lay

    @staticmethod
    def makers(vendor: Maker | None, serials: Sequence[int | None]) -> list[Maker | None]:
        """Return the makers of each device's dictionary: ``vendor`` for all, and a serial number, if not
        None.

        A device raises BadInput as it is made, if its data sheet has no serial number.
        """

        def numbered(serial_number: int) -> Maker:
            def make(dictionary: ObjectDictionary) -> None:
                if vendor is not None:
                    vendor(dictionary)
                if not _number(dictionary, serial_number):
                    expected = "a data sheet that has the serial number, 1018h:04"
                    raise BadInput("--serial", "", serial_number, expected)

            return make

        return [vendor if serial is None else numbered(serial) for serial in serials]

    def write_data_sheet(self, dictionary: ObjectDictionary, announce: Callable[[str], None]) -> None:
        """Write the EDS of the device that has ``dictionary``, if requested. Raises BadInput."""
        if self.export is None:
            return
        write_file("--export-eds", self.export, export_eds(dictionary).encode("latin-1", "replace"))
        announce(f"its data sheet is {self.export}")

    def memory(self, nodes: Sequence[int]) -> FileStore | None:
        """Return the store of the one device in ``nodes``. Raises BadInput for several, or for a foreign
        file."""
        if self.store is None:
            return None
        if len(nodes) > 1:
            raise BadInput(
                "--store",
                "",
                str(self.store),
                "one --node, for the file is the memory of one device",
                "start a process for each node, each with a file of its own",
            )
        store = FileStore(self.store)
        store.load()
        return store


def _number(dictionary: ObjectDictionary, serial_number: int | None) -> bool:
    """Write it to 1018h:4, overriding the sheet's own; False if there is no such object."""
    variable = dictionary.get(Cia301.IDENTITY, _SERIAL_NUMBER)
    if variable is not None and serial_number is not None:
        variable.default = variable.value = serial_number
    return variable is not None


def _differences(made_for: Commissioning, nodes: Sequence[int], bitrate_bit_s: int | None) -> Iterator[str]:
    if made_for.node_id is not None and nodes and made_for.node_id not in nodes:
        yield f"made for node {made_for.node_id}, simulated as {', '.join(map(str, nodes))}"
    rate = made_for.bit_rate_kbit_s
    if rate and bitrate_bit_s is not None and rate * 1000 != bitrate_bit_s:
        yield f"made for {rate} kbit/s, the bus runs at {bitrate_bit_s / 1000:.0f} kbit/s"
