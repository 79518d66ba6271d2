"""Evaluation: a driver and tracks → a row an episode → a summary with intervals."""
