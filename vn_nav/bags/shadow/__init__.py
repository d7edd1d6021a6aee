"""A policy that is driven along a bag, and how its drive compares with the recorded one."""
