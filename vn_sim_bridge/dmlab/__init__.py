"""The worker of DeepMind Lab: the engine in a process and a virtual environment of its own."""
