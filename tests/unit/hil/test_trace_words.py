"""Each service of CANopen in the words of a trace: frames as the standards lay them out, and what is said."""

import pytest

from servobench.hil.reviewing.trace.decoder import decode
from servobench.hil.reviewing.trace.frame_columns import LogFrame


def said(text: str, error: bool = False) -> str:
    """Of one frame."""
    can_id, _, data = text.partition("#")
    (entry,) = decode([LogFrame(1, 1000, "can0", int(can_id, 16), bytes.fromhex(data), error=error)])
    return entry.text


LSS = {
    # CiA 305: switch state global, selective
    "7E5#0400000000000000": "switch all to state waiting",
    "7E5#0401000000000000": "switch all to state configuration",
    "7E5#0402000000000000": "switch all to state 2",
    "7E5#4078563412000000": "select vendor-ID 12345678h",
    "7E5#4178563412000000": "select product code 12345678h",
    "7E5#4278563412000000": "select revision number 12345678h",
    "7E5#4378563412000000": "select serial number 12345678h",
    "7E4#4400000000000000": "answer: selected",
    # identify remote slave
    "7E5#4601000000000000": "identify vendor-ID 00000001h",
    "7E5#4701000000000000": "identify product code 00000001h",
    "7E5#4801000000000000": "identify lowest revision 00000001h",
    "7E5#4901000000000000": "identify highest revision 00000001h",
    "7E5#4A01000000000000": "identify lowest serial 00000001h",
    "7E5#4B01000000000000": "identify highest serial 00000001h",
    "7E5#4C00000000000000": "is anybody without node-ID?",
    "7E4#4F00000000000000": "answer: identified",
    "7E4#5000000000000000": "answer: here is one without node-ID",
    # fast scan: number, bit, part, next part
    "7E5#5100000000800000": "fast scan: is anybody without node-ID?",
    "7E5#51000000801F0000": "fast scan: vendor-ID 80000000h down to bit 31",
    "7E5#5178563412000001": "fast scan: vendor-ID 12345678h down to bit 0, then product code",
    "7E5#5178563412000303": "fast scan: serial number 12345678h down to bit 0",
    "7E5#5178563412000404": "fast scan: part 4 12345678h down to bit 0",
    # configuration
    "7E5#1105000000000000": "configure node-ID 5",
    "7E5#11FF000000000000": "configure no node-ID",
    "7E4#1100000000000000": "answer: node-ID: done",
    "7E4#1101000000000000": "answer: node-ID: refused, node-ID out of range",
    "7E4#1107000000000000": "answer: node-ID: refused, error 7",
    "7E4#11FF090000000000": "answer: node-ID: refused, error 9 of the maker",
    "7E5#1300000000000000": "configure bit timing: table 0, 1000 kbit/s",
    "7E5#1300010000000000": "configure bit timing: table 0, 800 kbit/s",
    "7E5#1300020000000000": "configure bit timing: table 0, 500 kbit/s",
    "7E5#1300030000000000": "configure bit timing: table 0, 250 kbit/s",
    "7E5#1300040000000000": "configure bit timing: table 0, 125 kbit/s",
    "7E5#1300050000000000": "configure bit timing: table 0, index 5",
    "7E5#1300060000000000": "configure bit timing: table 0, 50 kbit/s",
    "7E5#1300070000000000": "configure bit timing: table 0, 20 kbit/s",
    "7E5#1300080000000000": "configure bit timing: table 0, 10 kbit/s",
    "7E5#1300090000000000": "configure bit timing: table 0, found by the device",
    "7E5#13000A0000000000": "configure bit timing: table 0, index 10",
    "7E5#1301090000000000": "configure bit timing: table 1, index 9",
    "7E4#1300000000000000": "answer: bit timing: done",
    "7E4#1301000000000000": "answer: bit timing: refused, bit timing not supported",
    "7E5#15E8030000000000": "activate bit timing after 1000 ms",
    "7E5#1700000000000000": "store configuration",
    "7E4#1700000000000000": "answer: store: done",
    "7E4#1701000000000000": "answer: store: refused, storing not supported",
    "7E4#1702000000000000": "answer: store: refused, storage medium does not answer",
    # inquiries
    "7E5#5A00000000000000": "ask vendor-ID",
    "7E5#5B00000000000000": "ask product code",
    "7E5#5C00000000000000": "ask revision number",
    "7E5#5D00000000000000": "ask serial number",
    "7E4#5D78563412000000": "answer: serial number is 12345678h",
    "7E5#5E00000000000000": "ask node-ID",
    "7E4#5E05000000000000": "answer: node-ID is 5",
    "7E5#6000000000000000": "command 60h",
    "7E5#04": "LSS of 1 bytes; it has 8",
}
OTHERS = {
    # CiA 301: NMT, SYNC, TIME, EMCY, error control
    "000#0105": "start, node 5",
    "000#0200": "stop, all nodes",
    "000#8005": "enter pre operational, node 5",
    "000#8100": "reset node, all nodes",
    "000#8205": "reset communication, node 5",
    "000#8305": "command 83h, node 5",
    "080#07": "SYNC 7",
    "100#000000000000": "1984-01-01 00:00:00.000",
    "100#E80300000100": "1984-01-02 00:00:01.000",
    "100#E80300F00100": "1984-01-02 00:00:01.000",  # the four highest bits are reserved
    "100#0000": "TIME of 2 bytes; it has 6",
    "705#00": "boot-up",
    "705#04": "stopped",
    "705#05": "operational",
    "705#7F": "pre-operational",
    "705#06": "state 06h",
    "705#FF": "pre-operational, toggle 1",
    "705#0505": "error control of 2 bytes; it has 1",
    "085#": "EMCY of 0 bytes; it has 8",
    "085#10": "EMCY of 1 bytes; it has 8",
}


@pytest.mark.parametrize("frame", [*LSS, *OTHERS])
def test_a_frame_is_told_as_its_standard_means_it(frame: str) -> None:
    assert said(frame) == (LSS | OTHERS)[frame]


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        # linux/can/error.h: the class in the identifier; controller in data[1], protocol in data[2] and [3]
        ("001#0000000000000000", "transmission timed out"),
        ("002#0000000000000000", "arbitration lost"),
        ("010#0000000000000000", "transceiver"),
        ("020#0000000000000000", "no acknowledgement"),
        ("040#0000000000000000", "bus-off"),
        ("080#0000000000000000", "bus error"),
        ("100#0000000000000000", "controller restarted"),
        ("004#0001000000000000", "controller (receive overflow)"),
        ("004#0002000000000000", "controller (transmit overflow)"),
        ("004#0004000000000000", "controller (receive warning)"),
        ("004#0008000000000000", "controller (transmit warning)"),
        ("004#0010000000000000", "controller (receive error passive)"),
        ("004#0020000000000000", "controller (transmit error passive)"),
        ("004#0040000000000000", "controller (error active)"),
        ("008#0000010000000000", "protocol violation (single bit)"),
        ("008#0000020000000000", "protocol violation (form)"),
        ("008#0000040000000000", "protocol violation (stuff)"),
        ("008#0000080000000000", "protocol violation (dominant bit not sent)"),
        ("008#0000100000000000", "protocol violation (recessive bit not sent)"),
        ("008#0000200000000000", "protocol violation (overload)"),
        ("008#0000400000000000", "protocol violation (active error announcement)"),
        ("008#0000800000000000", "protocol violation (while transmitting)"),
        ("008#0000000800000000", "protocol violation (in the CRC sequence)"),
        ("080#0001010800000000", "bus error"),
        ("204#0010000000000780", "controller (receive error passive, counters: transmit 7, receive 128)"),
        ("200#0000000000000102", "no class of error (counters: transmit 1, receive 2)"),
        ("040#", "bus-off"),
    ],
)
def test_an_error_frame_is_told_as_the_kernel_means_it(frame: str, told: str) -> None:
    assert said(frame, error=True) == told
