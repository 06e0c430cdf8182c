"""Load machines: in a drive's object dictionary, or instruments of their own."""
