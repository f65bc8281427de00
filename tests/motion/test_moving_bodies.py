"""Bodies that move: velocities against closed forms, and what they follow."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.errors import MitsonarError
from mitsonar.motion.bodies import MeshSequence, MovingBodies
from mitsonar.motion.pose import Pose
from mitsonar.motion.trajectory import Trajectory


def test_velocities_are_those_of_the_path_beside_each_time() -> None:
    """1 m/s to the north for 2 s, then 2 m/s to the east with a turn of 0.3 rad/s to starboard: about -z."""
    poses = np.array([[0, 0, 1, 0, 0, 0], [0, 2, 1, 0, 0, 0], [2, 2, 1, 0, 0, 0.3]], dtype=float)
    bodies = MovingBodies.of({"fish": Trajectory(poses, np.array([0.0, 2.0, 3.0]))})
    result = bodies.velocities([-1, 0, 1, 2.5, 3, 4])[:, 0]
    north, east, still = (0, 1, 0, 0, 0, 0), (2, 0, 0, 0, 0, -0.3), (0,) * 6
    np.testing.assert_allclose(result, [still, north, north, east, east, still], atol=1e-9)


def test_what_follows_the_vehicle_has_its_path() -> None:
    path = Trajectory.between(Pose(0, 0, 1), Pose(0, 1, 1), 2, 1.0)
    assert MovingBodies.of({"hull": "vehicle"}, vehicle=path).paths == (path,)
    with pytest.raises(MitsonarError, match="hull follows the vehicle"):
        MovingBodies.of({"hull": "vehicle"})


def test_a_sequence_of_meshes_runs_on_straight_lines_and_round() -> None:
    corners = np.arange(3, dtype=np.float32)[:, None, None] * np.ones((1, 4, 3), np.float32)
    loop, once = MeshSequence(corners, 2.0), MeshSequence(corners, 2.0, loop=False)
    for time, round_, straight in ((0.0, 0, 0), (0.75, 1.5, 1.5), (1.25, 1.0, 2.0), (1.5, 0, 2), (-0.5, 2, 0)):
        assert loop(time) == pytest.approx(np.full((4, 3), round_))
        assert once(time) == pytest.approx(np.full((4, 3), straight))
    with pytest.raises(MitsonarError, match="meshes are vertices"):
        MeshSequence(corners[0], 2.0)
    with pytest.raises(MitsonarError, match="must be positive"):
        MeshSequence(corners, 0.0)
