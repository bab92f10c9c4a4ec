"""Evaluators: score the newest weights on a fixed set of test episodes.

Start with `evaluator.py`. May import worker.play and worker.talk.
"""
