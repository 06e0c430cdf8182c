"""The journal of changes to a drive, and their restoration byte for byte."""
