"""Instruments: sonars, their presets, and the views of a ping."""
