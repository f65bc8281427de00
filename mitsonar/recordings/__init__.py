"""Files of real sonars, one module a format: they become sonar frames, and runs become such files."""
