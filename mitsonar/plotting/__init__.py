"""Figures of what they are handed."""
