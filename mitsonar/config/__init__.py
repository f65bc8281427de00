"""What a recipe may say, of data sets and of trainings; pure data."""
