"""Keys of recipes of data sets and trainings, checked; pure data."""
