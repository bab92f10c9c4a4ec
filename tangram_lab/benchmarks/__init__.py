"""Measurements and long trials: tangram-bench. `README.md` beside this lists them.

Start with `stages.py`. Folders: speed (rates, against what else one could do), sight (how well
tokens and silhouettes are seen), trials (faults, attacks, endurance). `measure.py`, `trainings.py`
and `setups.py` are of all three.
"""
