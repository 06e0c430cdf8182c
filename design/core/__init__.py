"""The mathematics computed in C, and the C build for this room and virtual_bus (decision 0026)."""
