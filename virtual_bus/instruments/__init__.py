"""What hangs on a serial line in the simulated world: a dynamometer, CAN adapters."""
