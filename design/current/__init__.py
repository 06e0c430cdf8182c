"""Current controllers of one axis and of both together."""
