"""Rates, each measured in turns with something else: learner, workers, whole trainings.

Start with `learner.py`. `fetch.py` trains beside Stable-Baselines3.
"""
