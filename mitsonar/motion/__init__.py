"""Poses, motions and trajectories, and how far estimated ones are from true ones."""
