"""What is wrong with a live ROS 2 graph before a robot drives on it, and what to type."""
