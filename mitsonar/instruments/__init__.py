"""What the instruments are: sonars, their presets, and the views of a ping."""
