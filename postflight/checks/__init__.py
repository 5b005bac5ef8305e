"""What is odd about the sensors of a flight folder: cross-checks of units, axes, clocks and tracks."""
