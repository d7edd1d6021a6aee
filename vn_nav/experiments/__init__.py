"""The thesis's experiments, run again: what they are, how they run, what came out."""
