"""Faults of every kind, one after the other; after each, the store must be that of an undisturbed run.

`make soak MINUTES=10 SEED=…` takes random steps until the time is over. What failed can be repeated by the command that is
printed. tests/integration/test_soak_steps.py takes a fixed list of steps, with faults at named points instead of at times.
"""
