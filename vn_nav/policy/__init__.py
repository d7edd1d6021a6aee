"""The policy: its network, its checkpoints and its NumPy runtime."""
