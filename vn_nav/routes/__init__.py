"""Remembered routes: chains of pictures that a robot drives along."""
