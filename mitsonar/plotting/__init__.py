"""Figures, pictures and videos of results."""
