"""Measurements and long trials: tangram-bench. `README.md` beside this lists them.

Start with `stages.py`. Folders: speed (rates, against what else one could do), trials (faults and
attacks). `measure.py`, `trainings.py` and `setups.py` are of both.
"""
