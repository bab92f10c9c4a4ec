"""Films of episodes, and pictures that an agent saw. Imports no other folder of tangram_game."""
