"""Shapes, token sets, and exact geometry of polygons in the plane.

Start with `shapes.py` and `layout.py`. `overlap.py` has the areas that rewards need,
`dissections.py` the search that fills an outline. Imports no other folder of tangram_sim, and not
its `config.py`.
"""
