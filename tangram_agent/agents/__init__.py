"""The agents, a folder for each: what one of them needs and the others do not."""
