"""The fastest line: where to drive on a track, and how fast, for a car with given limits."""
