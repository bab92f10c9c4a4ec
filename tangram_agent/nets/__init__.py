"""Layers that read graphs, and their parameters as named arrays.

Start with `networks.py`. May import tangram_core and torch.
"""
