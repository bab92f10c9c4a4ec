"""Long trials of real trainings: random faults, attacks, mutated messages, memory.

Start with `chaos.py`; `attack.py` runs all attacks, `target.py` says what is attacked.
"""
