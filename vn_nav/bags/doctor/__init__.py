"""What is wrong with a bag, and what can be saved of a damaged one."""
