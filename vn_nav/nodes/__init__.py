"""The ROS nodes: the only place of vn_nav that imports rclpy and message packages."""
