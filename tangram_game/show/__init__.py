"""Films of episodes, and what an agent was shown. Imports no other folder of tangram_game."""
