"""The Foxglove layout of the tutorial shows what an MCAP file of a run holds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_frames import over_ground, sway
from rosbags.highlevel import AnyReader

from mitsonar.recordings.write_mcap import WORLD, write_mcap

LAYOUT = json.loads((Path(__file__).parents[2] / "docs" / "tutorials" / "foxglove.json").read_text(encoding="utf-8"))

PANELS: dict[str, Any] = LAYOUT["configById"]

SHOWN = {"sensor_msgs/msg/CompressedImage": "Image", "nav_msgs/msg/Odometry": "3D"}
"""Panels that draw a message of a type; a plot draws any number."""


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The first message of each topic of an MCAP file."""
    path = tmp_path_factory.mktemp("layout") / "run.mcap"
    write_mcap([over_ground(sway(3))], path)
    result: dict[str, Any] = {}
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            result.setdefault(connection.topic, reader.deserialize(raw, connection.msgtype))
    return result


def panels_in(layout: str | dict[str, Any]) -> Iterator[str]:
    """The panels of a tree of splits."""
    if isinstance(layout, str):
        yield layout
    else:
        yield from panels_in(layout["first"])
        yield from panels_in(layout["second"])


def test_every_panel_has_a_place_and_a_configuration() -> None:
    placed = list(panels_in(LAYOUT["layout"]))
    assert sorted(placed) == sorted(PANELS)
    assert {name.partition("!")[0] for name in placed} == {"Image", "3D", "Plot"}


def test_topics_of_pictures_and_scene_exist_with_types_that_the_panels_draw(messages: dict[str, Any]) -> None:
    topics = {(panel["imageMode"]["imageTopic"], "Image") for panel in PANELS.values() if "imageMode" in panel}
    topics |= {(topic, "3D") for panel in PANELS.values() for topic in panel.get("topics", {})}
    assert len(topics) == 2
    for topic, kind in topics:
        assert SHOWN[messages[topic].__msgtype__] == kind


def test_the_scene_is_drawn_in_the_world_of_the_transforms(messages: dict[str, Any]) -> None:
    scene = PANELS["3D!dive"]
    assert scene["followTf"] == WORLD == messages["/tf"].transforms[0].header.frame_id
    assert scene["layers"]["grid"]["frameId"] == WORLD


def test_plotted_paths_lead_to_numbers(messages: dict[str, Any]) -> None:
    """Behind the fields of a message, Foxglove's function `rpy` takes a quaternion."""
    paths = [path["value"] for panel in PANELS.values() for path in panel.get("paths", [])]
    assert len(paths) == 4
    for path in paths:
        result = re.fullmatch(r"(/[\w/]+)\.([\w.]+?)(\.@rpy\.(roll|pitch|yaw)\.@degrees)?", path)
        assert result, path
        value = messages[result[1]]
        for field in result[2].split("."):
            value = getattr(value, field)
        if result[3]:
            assert value.__msgtype__ == "geometry_msgs/msg/Quaternion"
        else:
            assert np.isfinite(float(value))
