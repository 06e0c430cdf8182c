"""A twin: the simulated drive fitted to recordings of a real one."""
