"""What stands beside a score of the game and learned nothing: a formula that fits the motion first.

Start with `fitted.py`; the rivals that all tasks of tokens have are in tangram_tasks.rivals. Plays
and pairs tokens by worker; imports no other folder of tangram_game.
"""
