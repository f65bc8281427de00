"""Scenes that mitsonar ships: Mitsuba XML, trajectories to fly (TUM), meshes and textures."""
