"""This process and its machine: Ctrl-C, real time, progress, ``hil doctor``."""
