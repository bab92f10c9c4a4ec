"""What people run on a finished agent: tangram-eval and tangram-play.

Start with `evaluate.py` and `play.py`. Folders, each imports those behind it only: figures (what is
to be assembled), rivals (what learned nothing) and show (films and pictures). May import worker, to
play and to score, and tangram_vision; not master. Nothing that trains imports it.
"""
