"""A world on a slope: all of it turned about the line to starboard through the origin."""

from __future__ import annotations

from dataclasses import replace

from scipy.spatial.transform import Rotation

from mitsonar.worlds.world import Mesh, World

__all__ = ["sloped"]


def sloped(world: World, slope_deg: float) -> World:
    """Tilt a world so that its ground rises forward, along +y, by an angle [deg]; its standpoint stays where it is."""
    turn = Rotation.from_euler("x", slope_deg, degrees=True)

    def tilted(mesh: Mesh) -> Mesh:
        return replace(mesh, vertices=turn.apply(mesh.vertices))

    floor = None if world.floor is None else replace(world.floor, slope_deg=slope_deg)
    meshes = [tilted(mesh) for mesh in world.meshes]
    return replace(world, about=f"{world.about}, rising forward by {slope_deg:g} deg", meshes=meshes, floor=floor)
