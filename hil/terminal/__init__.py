"""The commands of ``hil``: their options and their output."""
