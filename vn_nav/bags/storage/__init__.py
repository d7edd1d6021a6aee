"""MCAP files and rosbag2 folders: written, read, and read in spite of damage."""
