"""Plays for a master, or scores what it has learned; what a training needs and no more.

Start with `play/player.py` and `score/evaluator.py`. Folders, each imports those behind it only:
score, play, talk. May import tangram_agent, tangram_vision, tangram_sim and tangram_core; neither
master nor tangram_game.
"""
