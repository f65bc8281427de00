"""Sensors of ROS bags: signs of their axes, noise of their covariances, and bags that tell none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import Maker, Sent, write_bag

from mitsonar.errors import MitsonarError
from mitsonar.mapping.sensors import open_sensors

TIMES = 1_700_000_000 + np.arange(0, 2, 0.1)
KINDS = ["one.bag", "two", "three_mcap"]


def imu(maker: Maker, time_s: float, rate: float, variance: float, frame: str = "imu") -> Any:
    return maker.make(
        "sensor_msgs/Imu",
        header=maker.header(time_s, frame),
        orientation=maker.vector([0, 0, 0, 1], "geometry_msgs/Quaternion"),
        orientation_covariance=np.zeros(9),
        angular_velocity=maker.vector([9, 9, rate]),
        angular_velocity_covariance=np.diag([9, 9, variance]).ravel(),
        linear_acceleration=maker.vector([0, 0, 0]),
        linear_acceleration_covariance=np.zeros(9),
    )


def twist(maker: Maker, time_s: float, velocity: tuple[float, float], variances: tuple[float, float]) -> Any:
    one = maker.make("geometry_msgs/Twist", linear=maker.vector([*velocity, 0]), angular=maker.vector([0, 0, 0]))
    covariance = np.diag([*variances, 1, 1, 1, 1]).astype(float).ravel()
    both = maker.make("geometry_msgs/TwistWithCovariance", twist=one, covariance=covariance)
    return maker.make("geometry_msgs/TwistWithCovarianceStamped", header=maker.header(time_s, "base"), twist=both)


@pytest.mark.parametrize("name", KINDS)
def test_a_bag_tells_a_gyroscope_and_velocities(name: str, tmp_path: Path) -> None:
    """Axes are forward, port, up: a positive rate turns to port, a positive y goes to port."""
    maker = Maker(name.endswith(".bag"))
    sent: list[Sent] = [("/imu", t, imu(maker, t, 0.2, 1e-4)) for t in TIMES]
    sent += [("/dvl", t, twist(maker, t, (0.5, 0.1), (4e-4, 9e-4))) for t in TIMES]
    result = open_sensors(write_bag(tmp_path / name, maker, sent))
    assert result.names == ["gyroscope", "DVL"]
    assert result.yaw_rate is not None
    assert result.sideways is not None
    assert result.forward is not None
    np.testing.assert_allclose(result.yaw_rate.time_s, TIMES, atol=1e-6)
    np.testing.assert_allclose(result.yaw_rate.values, -0.2)
    np.testing.assert_allclose(result.yaw_rate.std, 1e-2 * np.sqrt(0.1), rtol=1e-5)
    np.testing.assert_allclose(result.sideways.values, -0.1)
    np.testing.assert_allclose([result.sideways.std[0], result.forward.std[0]], [0.03, 0.02])
    np.testing.assert_allclose(result.forward.values, 0.5)


def test_axes_that_point_down_have_the_other_sign_and_readings_without_noise_are_left_out(tmp_path: Path) -> None:
    maker = Maker(ros1=True)
    variances = [1e-4] * 5 + [0.0, -1.0, np.nan] + [1e-4] * 12
    sent: list[Sent] = [("/imu", t, imu(maker, t, 0.2, v, "imu_frd")) for t, v in zip(TIMES, variances, strict=True)]
    result = open_sensors(write_bag(tmp_path / "down.bag", maker, sent))
    assert result.yaw_rate is not None
    assert len(result.yaw_rate.values) == 17
    np.testing.assert_allclose(result.yaw_rate.values, 0.2)


def test_bags_that_tell_no_sensor_are_refused(tmp_path: Path) -> None:
    maker = Maker(ros1=True)
    silent: list[Sent] = [("/imu", t, imu(maker, t, 0.2, 0.0)) for t in TIMES]
    with pytest.raises(MitsonarError, match="no sensor whose messages state their covariance"):
        open_sensors(write_bag(tmp_path / "silent.bag", maker, silent))
    two: list[Sent] = [(topic, t, imu(maker, t, 0.2, 1e-4)) for topic in ("/a", "/b") for t in TIMES]
    with pytest.raises(MitsonarError, match="several topics of sensor_msgs/msg/Imu"):
        open_sensors(write_bag(tmp_path / "two.bag", maker, two))
    (tmp_path / "cut.bag").write_bytes((tmp_path / "two.bag").read_bytes()[:900])
    with pytest.raises(MitsonarError, match="cannot read the bag"):
        open_sensors(tmp_path / "cut.bag")
    with pytest.raises(MitsonarError, match=r"none\.csv"):
        open_sensors(tmp_path / "none.csv")
