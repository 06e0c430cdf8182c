"""What a simulated CANopen device is built from: identity, PDO defaults, communication defaults."""

from dataclasses import dataclass, field

from virtual_bus.device.cob_id import NO_RTR, NOT_VALID


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Objects 1000h, 1008h..100Ah and 1018h."""

    device_type: int = 0
    vendor_id: int = 0
    product_code: int = 0
    revision_number: int = 0
    serial_number: int = 0
    device_name: str = "simulated device"


@dataclass(frozen=True, slots=True)
class PdoDefault:
    """One PDO as the device comes up."""

    cob_id: int
    """COB-ID without the node-ID, which is added; bit 31: not valid, bit 30: no RTR (TPDO)."""
    transmission_type: int
    mapping: tuple[int, ...] = ()
    """Mapping words, index << 16 | sub-index << 8 | bits, as in 1600h and 1A00h."""
    inhibit_time_100us: int = 0
    event_timer_ms: int = 0


def mapping_word(index: int, subindex: int, bits: int) -> int:
    """One entry of a PDO mapping parameter (CiA 301, 7.5.2.36)."""
    return index << 16 | subindex << 8 | bits


def unmapped_rpdos() -> tuple[PdoDefault, ...]:
    """RPDO 1..4 at the predefined COB-IDs, switched off, nothing mapped."""
    return tuple(PdoDefault(NOT_VALID | 0x200 + 0x100 * number, 255) for number in range(4))


def unmapped_tpdos() -> tuple[PdoDefault, ...]:
    """TPDO 1..4 at the predefined COB-IDs, switched off, nothing mapped."""
    return tuple(PdoDefault(NOT_VALID | NO_RTR | 0x180 + 0x100 * number, 255) for number in range(4))


@dataclass(frozen=True, slots=True)
class DeviceOptions:
    """Everything about a device's communication that its dictionary starts with."""

    identity: DeviceIdentity = DeviceIdentity()
    rpdos: tuple[PdoDefault, ...] = field(default_factory=unmapped_rpdos)
    """RPDO 1.. in order: 1400h.. and 1600h.."""
    tpdos: tuple[PdoDefault, ...] = field(default_factory=unmapped_tpdos)
    """TPDO 1.. in order: 1800h.. and 1A00h.."""
    heartbeat_ms: int = 0
    """Default of 1017h."""
    boot_after_reset_ms: int = 0
    """From an NMT reset, or a node-ID by LSS, until the boot-up message. From power-on it is none."""
    clock_offset_ns: int = 0
    """Reading of the device's own clock at power-on."""
    clock_drift_ppb: int = 0
    """How much faster than the bench the device's clock runs, parts per 10^9."""
