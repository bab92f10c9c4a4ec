"""Rates, each measured in turns with something else: wire, learner, whole trainings.

Start with `learner.py`. `sb3.py` is what trainings are compared with.
"""
