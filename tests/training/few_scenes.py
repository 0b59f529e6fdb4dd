"""Settings of a small training in two of several scenes at a time."""

SMALL = [
    *(f"agent.{name}=8" for name in ("hidden_size", "embedding_size")),
    "agent.history=1",
    "env.goals=random:2",
    "env.active_scenes=2",
    "env.scene_stay=96",
    "env.max_steps=6",
    "collector.num_envs=6",
    "collector.rollout=4",
    "scenes=[bathroom]",
    "autocast=false",
]
