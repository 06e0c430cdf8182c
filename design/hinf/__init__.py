"""H-infinity synthesis, and what it needs: weights, reduction, margins, robustness."""
