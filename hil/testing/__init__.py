"""What the pytest plugin hands to tests: drives, benches, and assertions on what they did."""
