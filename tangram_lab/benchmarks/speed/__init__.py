"""Rates, each measured in turns with something else: simulation, wire, learner, whole trainings.

Start with `sim.py`. `sb3.py` is what trainings are compared with.
"""
