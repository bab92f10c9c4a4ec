"""A picture from straight above -> where each token lies, and whether that is sure.

Start with `seeing.py`. Imports no other folder of tangram_vision.
"""
