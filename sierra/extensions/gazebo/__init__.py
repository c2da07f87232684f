"""The platform of Gazebo classic, and the program that drives it."""
