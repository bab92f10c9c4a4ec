"""The studio: a web page to play on with the agent.

`server.py` serves the page and checks the token, `session.py` talks with one page, `jobs.py` runs
searches and moves in two pools of processes. May import tangram_game, worker, tangram_vision and
what these import; only this package serves pages.
"""
