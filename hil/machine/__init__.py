"""This process and its machine: Ctrl-C, real time, progress, the disk, ``hil doctor``."""
