"""Runner on robots, reached over SSH: `sierra.runners.robots.runner` has the cycle of a run."""
