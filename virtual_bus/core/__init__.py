"""The native core: what of the simulated world is computed in C (decision 0026).

There is one implementation. Where the core is not built, or was built from other sources than those beside
it, importing this package raises BadInput, which says what to do.
"""

from servobench.design.core.build import LIBRARY, check_built
from servobench.drivers.errors import BadInput

check_built("virtual_bus", lambda found, expected: BadInput("the native core", LIBRARY, found, expected))
