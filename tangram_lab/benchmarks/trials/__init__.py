"""Long trials of real trainings: random faults and attacks.

Start with `chaos.py`. `attack.py` runs all attacks, on the trainings of `target.py`.
"""
