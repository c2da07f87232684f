"""The programs of the agent, which execute runs on a robot. They need no other modules but `sierra.worker`."""
