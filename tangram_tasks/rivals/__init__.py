"""What plays tokens and learned nothing: formulas and rules, to compare with.

Start with `baselines.py`. May import tangram_core, tangram_sim and what scores are made of.
"""
