"""Levels of echoes, and noise."""
