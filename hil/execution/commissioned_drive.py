"""A drive run by what commissioning found: held against its file, its settings written."""

from drivers.canopen.objects import SettingRefused
from drivers.canopen.sdo import object_name
from drivers.cia402.servo import ServoDrive
from drivers.errors import PeerFault
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
