"""Visual navigation for ROS 2: show a robot a picture, and it drives to where it was taken."""

__version__ = '0.2.0'
