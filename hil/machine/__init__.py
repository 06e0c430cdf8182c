"""This process and its machine: Ctrl-C, real time, progress, compiled modules, ``hil doctor``."""
