"""Cross-checks of a flight folder before a run: units, axes, time tags and tracks of its sensors."""
