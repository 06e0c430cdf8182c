"""What the loop writes in every cycle, in C (decision 0026).

Where it is not built, or was built from other sources than those beside it, importing this package raises
BadInput, which says what to do.
"""

from servobench.design.core.build import LIBRARY, check_built
from servobench.drivers.errors import BadInput

check_built("hil", lambda found, expected: BadInput("the core of hil", LIBRARY, found, expected))
