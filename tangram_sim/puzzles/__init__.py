"""Figures of the seven tans that people know: read without trust, fitted to exact tans, checked.

Start with `figures.py`; the JSON files are the library. May import tangram_sim.geometry.
"""
