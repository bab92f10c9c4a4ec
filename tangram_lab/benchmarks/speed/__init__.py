"""Rates of learner, workers and whole trainings, each measured in turns with an alternative.

Start with `learner.py`. `fetch.py` compares trainings with Stable-Baselines3.
"""
