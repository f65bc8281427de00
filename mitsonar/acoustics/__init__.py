"""Levels and noise; no Mitsuba."""
