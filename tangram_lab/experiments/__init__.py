"""Studies: train and test the agents of a study, then write tables and figures.

Start with `studies.py`, which reads conf/studies.yaml. May import master, worker and tangram_game.
"""
