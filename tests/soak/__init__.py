"""Faults of all kinds, one after the other; after each, the store must equal that of an undisturbed run.

`make soak MINUTES=10 SEED=…` executes random steps until the time is over. A failed step can be repeated by the printed
command. A step may also check properties of `tests.soak.properties` with random examples.
tests/integration/test_soak_steps.py executes a fixed list of steps, with faults at named points instead of at times.
"""
