"""ROS: the platform that starts launch files, and the reader of bags."""
