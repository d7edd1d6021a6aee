"""Scenes that are a grid of states: their files, their geometry, and how one is made."""
