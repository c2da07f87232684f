"""Platforms for simulators, as plug-ins on the public contract `sierra.plugin`: SUMO, MuJoCo, JSBSim, Gazebo, ROS."""
