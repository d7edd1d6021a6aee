"""A page in the browser, to watch and to drive by. ROS is `nodes/dashboard_node`'s alone."""
