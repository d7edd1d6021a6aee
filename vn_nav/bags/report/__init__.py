"""A page about a recorded drive, and about what a policy would have done on it."""
