"""Pictures -> tokens; silhouettes -> tokens that fill them. Workers only, by OpenCV.

Start with `pictures/seeing.py` and `silhouettes/silhouettes.py`. Folders, each imports those behind
it only: given, silhouettes, pictures. May import tangram_sim and tangram_core.
"""
