"""Platforms of simulators that are installed as Python packages: SUMO, MuJoCo and JSBSim."""
