"""The part of the way of a frame that is written in C (decision 0026): the frame, the link and the pump.

If it is not built, or was built from other sources than the present ones, importing this package raises
BadInput with the cure.
"""

from servobench.design.core.build import LIBRARY, check_built
from servobench.drivers.errors import BadInput

check_built("drivers", lambda found, expected: BadInput("the core of drivers", LIBRARY, found, expected))
