"""The loop as it runs: sampled, with losses and varying delays; certified, and searched for its worst
case."""
