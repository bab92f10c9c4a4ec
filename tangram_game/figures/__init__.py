"""What a finished agent is to assemble: puzzles, photographs, silhouettes, hidden pieces.

Start with `puzzles.py`. `methods.py` says how a silhouette is filled. May import
tangram_game.show.
"""
