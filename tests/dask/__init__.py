"""Campaigns on a Dask cluster of this machine; apart, as its processes start in seconds."""
