"""The loop that really runs: sampled, with losses and delays that vary; certified and found."""
