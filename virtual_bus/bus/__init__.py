"""One bus segment to the bit: arbitration, errors, the simulated bus, the hub."""
