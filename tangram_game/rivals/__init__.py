"""What stands beside a score and learned nothing: chance, formulas, the oracle, rules.

Start with `baselines.py`. Plays and pairs tokens by worker; imports no other folder of
tangram_game.
"""
