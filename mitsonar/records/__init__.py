"""What a ray or a ping brought back, in the one form that everything downstream reads."""
