"""Worker processes: players, evaluators, and the command tangram-status.

Start with `play/player.py` and `score/evaluator.py`. Folders: score, play, talk; each may import
only folders to its right in this list. May import tangram_agent, tangram_vision, tangram_sim and
tangram_core, but not master or tangram_game.
"""
