"""Training of networks, their evaluation, and the thesis's tables again."""
