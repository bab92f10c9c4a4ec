"""An outline, or a picture of one -> where tokens lie that fill it, or come nearest to it.

Start with `silhouettes.py` (exact outlines) and `silhouette_pictures.py`. May import
tangram_vision.pictures.
"""
