"""Fill an outline, or a picture of one, with tokens; or find the nearest figure.

Start with `silhouettes.py` (exact outlines) and `silhouette_pictures.py`. May import
tangram_vision.pictures.
"""
