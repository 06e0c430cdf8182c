"""Conversion between python-can's message and the frame."""

import can

from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import ERROR_FLAG, WireFrame


def frame_of(message: can.Message) -> WireFrame:
    """Convert ``message`` to a frame.

    Raises can.CanOperationError for a message beyond classical CAN: FD and error frames, an identifier or a
    length out of range.
    """
    can_id, extended, dlc = message.arbitration_id, message.is_extended_id, message.dlc
    if message.is_fd or message.is_error_frame:
        raise can.CanOperationError("only data and remote frames of classical CAN can be sent on this bus")
    if not 0 <= can_id < (1 << 29 if extended else 1 << 11):
        bits = 29 if extended else 11
        raise can.CanOperationError(f"identifier 0x{can_id:X} does not fit into {bits} bits")
    if not 0 <= dlc <= 8:
        raise can.CanOperationError(f"{dlc} data bytes; a classical CAN frame carries at most 8")
    if message.is_remote_frame:
        return WireFrame(can_id, b"", extended, True, dlc)
    if len(message.data) != dlc:
        raise can.CanOperationError(f"DLC {dlc} and {len(message.data)} data bytes contradict each other")
    return WireFrame(can_id, bytes(message.data), extended)


def message_of(
    frame: WireFrame, at: Instant, *, is_rx: bool = True, channel: str | None = None
) -> can.Message:
    """Return the message of a frame that ended on the bus at ``at``; its timestamp is that instant in
    seconds."""
    can_id, data, extended = frame.can_id, frame.data, frame.extended
    remote, remote_length = frame.remote, frame.remote_length
    if can_id >= ERROR_FLAG:
        return can.Message(
            timestamp=at * 1e-9,
            arbitration_id=can_id - ERROR_FLAG,
            is_error_frame=True,
            dlc=len(data),
            data=data,
            channel=channel,
        )
    return can.Message(
        timestamp=at * 1e-9,
        arbitration_id=can_id,
        is_extended_id=extended,
        is_remote_frame=remote,
        dlc=remote_length if remote else len(data),
        data=data,
        is_rx=is_rx,
        channel=channel,
    )
