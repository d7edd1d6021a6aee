"""From a drive's pictures and odometry to poses that agree, and to a place to train in."""
