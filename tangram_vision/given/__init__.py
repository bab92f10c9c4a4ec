"""Read untrusted files of users: photographs, pictures, drawings and silhouettes.

Start with `photos.py` and `silhouette_files.py`. May import the other folders of tangram_vision.
"""
