"""Geometry of images: scan conversion, level ground, height and attitude."""
