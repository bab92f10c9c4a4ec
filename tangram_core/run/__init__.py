"""What the processes of a run share: how they work together, end, are watched, and what came of it.

Start with `service.py`. May import the rest of tangram_core.
"""
