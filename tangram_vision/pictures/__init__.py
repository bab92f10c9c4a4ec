"""Find each token in a picture from straight above, and whether its pose is certain.

Start with `seeing.py`. Imports no other folder of tangram_vision.
"""
