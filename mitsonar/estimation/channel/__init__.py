"""Estimators of motion from impulse responses, without training."""
