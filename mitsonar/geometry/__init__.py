"""Where a cell of an image lies, and how it moves with the sonar."""
