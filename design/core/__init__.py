"""What of the mathematics is computed in C, and how C is built here and in virtual_bus (decision 0026)."""
