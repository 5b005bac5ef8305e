"""A run's trajectory and deflections in the formats of other programs."""
