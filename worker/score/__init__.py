"""Scoring the newest weights on fixed tests: the tests, what they are worth, the loop.

Start with `evaluator.py`. May import worker.play and worker.talk.
"""
