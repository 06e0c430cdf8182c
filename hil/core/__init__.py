"""The part of the loop written in C that runs in every cycle (decision 0026).

If it is not built, or was built from other sources than the present ones, importing this package raises
BadInput with the cure.
"""

from servobench.design.core.build import LIBRARY, check_built
from servobench.drivers.errors import BadInput

check_built("hil", lambda found, expected: BadInput("the core of hil", LIBRARY, found, expected))
