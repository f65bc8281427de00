"""Worlds: a seed becomes a Mitsuba scene and its meshes on disk."""
