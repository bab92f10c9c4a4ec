"""The world of Tangram. Importing it registers its ids with gymnasium; see `register`."""

from tangram_sim.register import register_when_loaded

register_when_loaded()
