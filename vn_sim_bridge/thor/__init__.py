"""AI2-THOR: its client, frames, names and rooms, behind `simulators/thor.py`."""
