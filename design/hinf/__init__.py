"""H-infinity synthesis and its tools: weights, reduction, margins, robustness."""
