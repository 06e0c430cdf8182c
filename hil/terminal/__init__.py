"""The commands of ``hil``: options, and what is printed."""
