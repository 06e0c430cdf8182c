"""Vendor knowledge as TOML: quirks of their drives, their error codes."""
