"""Experiments and benchmarks. May import every package but tangram_cli; no package imports it.

Start with `experiments/studies.py` and `benchmarks/stages.py`.
"""
