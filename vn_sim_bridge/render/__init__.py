"""Renderers: a Scene and poses become colour, depth and labels."""
