"""Simulators: places, motion, pictures and tasks, and the bridge that shows them as a robot."""
