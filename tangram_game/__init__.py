"""Commands for a finished agent: tangram-eval, tangram-play and tangram-export.

Start with `evaluate.py` and `play.py`. Folders: figures (targets to assemble), which may import
show (films and pictures). May import worker, to play and to score, and tangram_vision; not master.
No training code imports this package.
"""
