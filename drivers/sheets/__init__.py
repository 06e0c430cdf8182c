"""Data sheets: EDS and DCF read, the object dictionary, what a drive can serve by them."""
