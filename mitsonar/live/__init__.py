"""Frames leave the process while they are made, or for a viewer: a Foxglove server, a ROS 2 node, Rerun recordings."""
