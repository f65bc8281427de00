"""Scenes and simulators that tests of channels share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from helpers import diffuse, floor, scene
from numpy.typing import NDArray

from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView, Hydrophone
from mitsonar.motion.pose import Pose
from mitsonar.simulation.channel import ChannelSimulator

if TYPE_CHECKING:
    import mitsuba as mi

    from mitsonar.simulation.scatterers import Scatterers

C = 1500.0
LEVEL = Pose(0, 0, 10)
CELLS = {"type": "cell_noise", "cells": 512.0, "seed": 5}
EVERYWHERE = FieldOfView(shape="all")


def received_from(place: tuple[float, float, float] = (0, 0, 0), **field: Any) -> Hydrophone:
    return Hydrophone(name="one", position=place, field=FieldOfView(**field) if field else EVERYWHERE)


def cells_floor(half: float = 14.0, cells: float = 512.0) -> dict[str, object]:
    return floor(diffuse({**CELLS, "cells": cells}), half)


def unmerged(**shapes: Any) -> mi.Scene:
    """A scene of these shapes, each with its own name: Mitsuba would merge rectangles and meshes."""
    import mitsuba as mi

    loaded = mi.load_dict({"type": "scene", **shapes}, optimize=False)
    assert isinstance(loaded, mi.Scene)
    return loaded


def simulator(sonar: ChannelSonar, **shapes: Any) -> ChannelSimulator:
    return ChannelSimulator(scene(**shapes), sonar)


def scatterers_of(made: ChannelSimulator) -> Scatterers:
    from mitsonar.simulation.scatterers import _WorldScatterers

    assert isinstance(made.tracer.source, _WorldScatterers)
    return made.tracer.source.scatterers


def points(made: ChannelSimulator) -> NDArray[np.float64]:
    return np.asarray(scatterers_of(made).place, dtype=float)
