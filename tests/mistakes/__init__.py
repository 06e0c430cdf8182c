"""Nameplates with the mistakes that people make, commissioned on drawn drives."""
