"""Recorded drives: rosbag2 bags in MCAP, written and read without a ROS installation."""
