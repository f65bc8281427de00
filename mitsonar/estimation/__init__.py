"""Frames become motion: the estimator protocol, and one method a file."""
