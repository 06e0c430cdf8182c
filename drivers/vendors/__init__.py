"""What is known of makers, as TOML: quirks of their drives, their error codes."""
