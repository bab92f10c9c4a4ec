"""Figures of the seven tans: untrusted files are read, checked and fitted to exact tans.

Start with `figures.py`; the JSON files are the library. May import tangram_sim.geometry.
"""
