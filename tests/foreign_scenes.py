"""Small scenes of other simulators, written by the tests."""

from __future__ import annotations

from pathlib import Path

import trimesh

URDF = """<?xml version="1.0"?>
<robot name="crane">
  <material name="orange"><color rgba="1 0.5 0 1"/></material>
  <link name="base"><visual><geometry><box size="1 2 0.5"/></geometry><material name="orange"/></visual>
    <collision><geometry><box size="3 3 3"/></geometry></collision></link>
  <link name="arm"><visual><origin xyz="0.5 0 0" rpy="0 1.5707963267948966 0"/>
    <geometry><cylinder radius="0.1" length="1"/></geometry></visual></link>
  <link name="hand"><visual><geometry><mesh filename="package://crane/ball.stl" scale="2 1 1"/></geometry></visual></link>
  <link name="twin"><visual><geometry><sphere radius="0.1"/></geometry></visual></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 1"/>
    <axis xyz="0 0 2"/><limit lower="-2" upper="2"/></joint>
  <joint name="slide" type="prismatic"><parent link="arm"/><child link="hand"/><origin xyz="1 0 0" rpy="0 0 0.5"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="1"/></joint>
  <joint name="follower" type="continuous"><parent link="base"/><child link="twin"/><origin xyz="0 0 -1"/>
    <axis xyz="1 0 0"/><mimic joint="shoulder" multiplier="-2" offset="0.25"/></joint>
</robot>
"""

SDF = """<?xml version="1.0"?>
<sdf version="1.9"><world name="harbour">
  <frame name="quay"><pose>10 0 0 0 0 1.5707963267948966</pose></frame>
  <model name="pier"><pose relative_to="quay">2 0 0 0 0 0</pose>
    <link name="wall"><visual name="v"><pose>0 0 1 0 0 0</pose><geometry><box><size>4 1 2</size></box></geometry>
      <material><diffuse>0.5 0.5 0.5 1</diffuse></material></visual>
      <collision name="c"><geometry><sphere><radius>3</radius></sphere></geometry></collision></link>
    <link name="door"><pose>2 0 0 0 0 0</pose><visual name="v"><pose>0.5 0 0 0 0 0</pose>
      <geometry><box><size>1 0.1 1</size></box></geometry></visual></link>
    <joint name="hinge" type="revolute"><parent>wall</parent><child>door</child><axis><xyz>0 0 1</xyz></axis></joint>
    <model name="lamp"><pose degrees="true">0 0 3 0 0 90</pose>
      <link name="bulb"><visual name="v"><pose relative_to="knob">0 0 0 0 0 0</pose>
        <geometry><sphere><radius>0.2</radius></sphere></geometry></visual></link>
      <frame name="knob" attached_to="bulb"><pose>1 0 0 0 0 0</pose></frame></model>
  </model>
  <include><uri>model://buoy</uri><name>red</name><pose>0 -5 0 0 0 0</pose></include>
</world></sdf>
"""

BUOY = """<sdf version="1.9"><model name="buoy" placement_frame="foot"><frame name="foot"><pose>0 0 -2 0 0 0</pose></frame>
  <link name="hull"><visual name="v"><geometry><mesh><uri>ball.stl</uri></mesh></geometry></visual></link>
  </model></sdf>
"""

USDA = """#usda 1.0
(
    upAxis = "Z"
    metersPerUnit = 0.01
)
def Xform "World" {
    double3 xformOp:translate = (100, 0, 0)
    float xformOp:rotateZ = 90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateZ"]
    def Sphere "ball" {
        double radius = 50
        double3 xformOp:translate = (200, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        color3f[] primvars:displayColor = [(0.25, 0.25, 0.25)]
    }
    def Mesh "plate" {
        point3f[] points = [(0, 0, 0), (100, 0, 0), (100, 100, 0), (0, 100, 0), (0, 200, 0)]
        int[] faceVertexCounts = [4, 3]
        int[] faceVertexIndices = [0, 1, 2, 3, 3, 2, 4]
        color3f[] primvars:displayColor = [(0.1, 0.1, 0.1), (0.8, 0.8, 0.8)] (
            interpolation = "uniform"
        )
    }
    def Cube "hidden" (
        apiSchemas = ["PhysicsCollisionAPI"]
    ) {
        token visibility = "invisible"
    }
}
"""


def make_urdf(folder: Path) -> None:
    """Write a crane of four links, and the ball in its hand."""
    (folder / "crane").mkdir()
    (folder / "crane" / "ball.stl").write_bytes(trimesh.creation.icosphere(1, 0.5).export(file_type="stl"))
    (folder / "crane.urdf").write_text(URDF)


def make_sdf(folder: Path) -> None:
    """Write a harbour, and a buoy that it includes."""
    (folder / "buoy").mkdir()
    (folder / "buoy" / "ball.stl").write_bytes(trimesh.creation.icosphere(1, 0.5).export(file_type="stl"))
    (folder / "buoy" / "buoy.sdf").write_text(BUOY)
    (folder / "buoy" / "model.config").write_text('<model><sdf version="1.9">buoy.sdf</sdf></model>')
    (folder / "harbour.sdf").write_text(SDF)


def make_usd(folder: Path) -> None:
    """Write a stage of a ball, a plate and a hidden cube."""
    (folder / "stage.usda").write_text(USDA)
