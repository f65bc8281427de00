"""Recipes of data sets and trainings: validated data models without behaviour."""
