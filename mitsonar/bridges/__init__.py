"""What speaks to other tools: URDF, SDF and USD scenes; Foxglove, ROS and Rerun; exports of data sets; Gymnasium."""
