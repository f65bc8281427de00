"""Estimators of the height over the ground."""
