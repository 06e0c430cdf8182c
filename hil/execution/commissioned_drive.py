"""A drive run by what commissioning found: its settings written first, its signs turned if need be."""

from drivers.canopen.objects import SettingRefused
from drivers.canopen.sdo import object_name
from drivers.cia402.servo import ServoDrive
from drivers.errors import PeerFault
from drivers.exchange import Command, DemandChange, Drive, Readback, Reading, SentCommand
from drivers.record import replaced
from hil.configuration.drive_file import DriveFile


def write_commissioned(drive: ServoDrive, file: DriveFile) -> None:
    """Hold the drive against its file and write the file's objects; the drive is connected and disabled.

    Raises PeerFault if it is another drive, SettingRefused or TransferAborted if it does not take a setting.
    """
    identity, marks = drive.identity, file.drive
    assert identity is not None, "connect comes first"
    for what, held, wanted in (
        ("vendor", identity.vendor, marks.vendor),
        ("product", identity.product, marks.product),
        ("serial number", identity.serial, marks.serial),
    ):
        if wanted and held != wanted:
            raise PeerFault(
                f"{drive.name} is not the drive that was commissioned",
                f"{what} {held}, its drive file says {wanted}",
                "commission this drive, or take its 'commissioned' out of the bench file",
            )
    network, node = drive.network, drive.node_id
    for setting in file.object:
        data = bytes.fromhex(setting.bytes)
        network.download(node, setting.index, setting.sub, data)
        held_bytes = network.upload(node, setting.index, setting.sub)
        if held_bytes != data:
            raise SettingRefused(
                f"{drive.name} holds {held_bytes.hex()} in {object_name(setting.index, setting.sub)}",
                f"{setting.bytes} was written to it",
            )


def as_the_loop_counts(drive: ServoDrive, file: DriveFile | None) -> "ServoDrive | TurnedDrive":
    """The drive itself, or turned round if its file says that it counts the other way."""
    return drive if file is None or not file.turned else TurnedDrive(drive, file)


class TurnedDrive(Drive):
    """A drive whose torque or velocity counts the other way, turned round for the loop."""

    def __init__(self, drive: ServoDrive, file: DriveFile) -> None:
        self._drive = drive
        self._torque = float(file.signs.torque)
        self._velocity = float(file.signs.velocity)

    def take_readings(self) -> list[Reading]:
        """The readings, as the loop counts."""
        return [
            replaced(
                reading,
                velocity_rad_s=reading.velocity_rad_s * self._velocity,
                torque_nm=reading.torque_nm * self._torque,
            )
            for reading in self._drive.take_readings()
        ]

    def take_readbacks(self) -> list[Readback]:
        """As the drive counts, like the raw value of a sent command."""
        return self._drive.take_readbacks()

    def take_demand_changes(self) -> list[DemandChange]:
        """As the drive counts, like a read-back."""
        return self._drive.take_demand_changes()

    def write(self, command: Command) -> SentCommand | None:
        """Send a set-point, as the drive counts."""
        return self._drive.write(replaced(command, torque_nm=command.torque_nm * self._torque))

    def check(self) -> None:
        """As the drive's own."""
        self._drive.check()
