"""Where a robot can stand, how far it is to a goal, and what it touches."""
