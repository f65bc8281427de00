"""Estimators of motion from two sonar images, without training."""
