"""Instruments on a serial line in the simulated world: a dynamometer, CAN adapters."""
