"""The Cramer-Rao lower bound of motion."""
