"""Estimators that a training made."""
