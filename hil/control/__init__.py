"""Controllers and compensators: what the loop computes its commands with."""
