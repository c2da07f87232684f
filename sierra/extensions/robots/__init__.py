"""Runner on robots, reached over SSH: `sierra.extensions.robots.runner` has the cycle of a run."""
