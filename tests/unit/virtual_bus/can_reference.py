"""A slow CAN frame on the wire, bit by bit in strings: the oracle for servobench.virtual_bus.bus.frame_image.

Written from the fields of ISO 11898-1 and with polynomial long division for the CRC, so that
it shares neither code nor method with the compiled count.
"""

import random

from servobench.virtual_bus.frame import Frame


def unstuffed_fields(frame: Frame) -> str:
    """Start of frame to the end of the data field, first bit first."""
    dlc = frame.remote_length if frame.remote else len(frame.data)
    rtr = "1" if frame.remote else "0"
    data = "" if frame.remote else "".join(f"{byte:08b}" for byte in frame.data)
    if frame.extended:
        identifier = f"{frame.can_id:029b}"
        return "0" + identifier[:11] + "1" + "1" + identifier[11:] + rtr + "00" + f"{dlc:04b}" + data
    return "0" + f"{frame.can_id:011b}" + rtr + "0" + "0" + f"{dlc:04b}" + data


def crc_sequence(fields: str) -> str:
    """Remainder of fields * x^15 by x^15+x^14+x^10+x^8+x^7+x^4+x^3+1."""
    generator = sum(1 << power for power in (15, 14, 10, 8, 7, 4, 3, 0))
    remainder = int(fields, 2) << 15
    for power in range(remainder.bit_length() - 1, 14, -1):
        if remainder >> power & 1:
            remainder ^= generator << (power - 15)
    return f"{remainder:015b}"


def stuff(bits: str) -> str:
    """A complement after every five equal bits, stuff bits counted."""
    out = ""
    for bit in bits:
        out += bit
        if len(out) >= 5 and len(set(out[-5:])) == 1:
            out += "0" if bit == "1" else "1"
    return out


def wire_bits(frame: Frame) -> str:
    """The whole frame on the wire, with delimiters, acknowledge and end of frame."""
    fields = unstuffed_fields(frame)
    return stuff(fields + crc_sequence(fields)) + "1" + "0" + "1" + "1" * 7


def random_frame(source: random.Random) -> Frame:
    """Any valid classical frame; data are often runs of equal bits, where stuffing happens."""
    extended = source.random() < 0.5
    can_id = source.randrange(1 << (29 if extended else 11))
    if source.random() < 0.15:
        return Frame(can_id, b"", extended, True, source.randrange(9))
    length = source.randrange(9)
    if source.random() < 0.4:
        data = bytes(source.choice((0x00, 0xFF, 0xF8, 0x07, 0xE0)) for _ in range(length))
    else:
        data = source.randbytes(length)
    return Frame(can_id, data, extended)
