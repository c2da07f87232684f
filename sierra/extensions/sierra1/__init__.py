"""`sierra init --from-sierra1`: a `sierra.toml` from a project of SIERRA 1.x, and a list of what it cannot carry over."""
