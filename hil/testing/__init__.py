"""The pytest plugin's tools for tests: drives, benches, and assertions about them."""
