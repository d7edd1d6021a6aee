"""Simulators behind one protocol: motion and pixels, no tasks."""
