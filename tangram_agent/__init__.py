"""The agents, and what they are made of, on the interface of `tangram_core.agent`.

`agents/` has a folder for each: `scene` (the paper's), `pair`, `outline`, `goal`. `base/` is what
agents of tokens share, `flat/` what agents of rows of numbers share, `nets/` are layers. `runs.py`
loads a finished run. May import tangram_tasks, tangram_sim and tangram_core; start with
`agents/scene/agent.py`.
"""
