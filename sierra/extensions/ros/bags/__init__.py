"""The reader of bags, the recordings of ROS: the messages of some topics become a table."""
