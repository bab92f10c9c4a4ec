"""What people give: photographs, picture files, drawings, silhouettes by name; read without trust.

Start with `photos.py` and `silhouette_files.py`. May import the other folders of tangram_vision.
"""
