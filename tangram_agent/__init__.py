"""The agents, which implement the interface of `tangram_core.agent`, and their shared parts.

`agents/` has a folder for each agent: `scene` (the paper's), `pair`, `outline`, `goal`, `push`.
`base/` is shared by agents of tokens, `flat/` by agents of rows of numbers. `nets/` has network
layers. `runs.py` loads a finished run. Start with `agents/scene/agent.py`. May import
tangram_tasks, tangram_sim and tangram_core.
"""
