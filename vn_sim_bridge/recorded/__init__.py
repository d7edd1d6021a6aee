"""Places made of recorded pictures."""
