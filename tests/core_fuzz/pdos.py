"""PDOs that the core is given: any mapping, values without room, and providers that do anything."""

import gc
import random
from typing import Any

from servobench.drivers.canopen.objects301 import BITS, DataType
from servobench.virtual_bus.core.native import PdoCodec
from servobench.virtual_bus.device.object_dictionary import Variable
from servobench.virtual_bus.device.pdo_parameters import Field, compiled
from tests.core_fuzz.fates import ODD, Refused


def pdos(draw: random.Random) -> None:
    """Mappings of up to 64 bits and beyond, whose variables refer back to their codec."""
    fields = [_field(draw) for _ in range(draw.randrange(9))]
    try:
        codec = compiled(fields)
        PdoCodec([(None, draw.randrange(70), draw.randrange(-1, 5))], False)
    except ValueError:
        return
    for _ in range(40):
        for field in fields:
            if field.variable is not None:
                field.variable.value = draw.choice([0, 1, True, draw.getrandbits(70) - (1 << 69), None, *ODD])
        try:
            codec.unpack(codec.pack() + draw.randbytes(draw.randrange(9)))
            codec.unpack(draw.randbytes(draw.randrange(12)))
        except (ValueError, TypeError, OverflowError, Refused):
            continue


def _field(draw: random.Random) -> Field:
    data_type = DataType(draw.choice([*BITS]))
    variable = Variable(0x2000, 0, "drawn", data_type)

    def provider() -> Any:
        if draw.random() < 0.1:
            raise Refused(variable)
        variable.provider = draw.choice([None, provider])
        gc.collect(0)
        return draw.getrandbits(BITS[data_type] - 1)

    variable.provider = draw.choice([None, provider])
    return Field(draw.choice([None, variable, variable]), BITS[data_type])
