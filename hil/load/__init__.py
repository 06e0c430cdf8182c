"""Load machines: in a drive's object dictionary, or separate instruments."""
