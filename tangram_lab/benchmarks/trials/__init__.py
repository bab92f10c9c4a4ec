"""Long trials of real trainings: random faults and attacks.

Start with `chaos.py`; `attack.py` runs all attacks, `target.py` says what is attacked.
"""
