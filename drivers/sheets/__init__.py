"""Data sheets: reading EDS and DCF files, the object dictionary, and a drive's capability by it."""
