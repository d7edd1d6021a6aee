"""One robot that is driven by velocities in ticks."""
