"""Reproduction: a received package is verified, its runs are executed again, and its claims are decided by the results."""
