"""Records of rays and pings, in the one form that all later stages read."""
