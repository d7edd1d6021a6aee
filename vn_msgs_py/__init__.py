"""Standard ROS messages to arrays and back; imports NumPy and OpenCV, never rclpy.

Messages are read by their fields, so those of rclpy and of rosbags both work.
"""
