"""Studies: which agents are trained and tested, running what is missing, tables and figures.

Start with `studies.py`, which reads conf/studies.yaml. May import master and worker, tangram_game
too.
"""
