"""The kinds of faults, each in a file of its own; :mod:`servobench.virtual_bus.faults.register` lists
them."""
