"""Devices served on a bus in real time, or on a simulated one, with their faults."""
