"""Speed measurements and long trials: tangram-bench. `README.md` in this folder lists them.

Start with `stages.py`. Folders: speed (rates compared with alternatives), trials (faults and
attacks). Both use `measure.py` and `trainings.py`.
"""
