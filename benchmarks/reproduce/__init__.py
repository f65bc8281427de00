"""Reproduction of Almanza-Medina's tables, and the odometry benchmark; installed as ``mitsonar.reproduction``."""
