"""The kinds of faults, each in a file of its own; :mod:`virtual_bus.faults.register` lists them."""
