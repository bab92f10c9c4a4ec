"""Targets for a finished agent: puzzles, photographs and silhouettes.

Start with `puzzles.py`. `targets.py` finds the kind of a target. May import
tangram_game.show.
"""
