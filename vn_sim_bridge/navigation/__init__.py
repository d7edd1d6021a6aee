"""Tasks on top of any simulator: goals, episodes, rewards."""
