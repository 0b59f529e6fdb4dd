"""A trained agent taken to rooms that it has never seen, as the folder of a run: ``vusfa transplant``."""

from __future__ import annotations

from pathlib import Path

import torch

from vusfa.errors import ConfigError
from vusfa.files import check_folder, say, write_json
from vusfa.modules import transplant
from vusfa.scenes import SceneSet
from vusfa.training import load_agent
from vusfa.training.checkpoint import save_checkpoint
from vusfa.training.content import NO_VALIDATION
from vusfa.training.scene_files import opened_from, scene_sources, settings_seen_from

__all__ = ["transplant_run"]


def transplant_run(checkpoint: Path, rooms: list[str], *, folder: Path) -> Path:
    """Take an agent to rooms that it has never seen.

    The folder is that of a run whose agent lives in these rooms and was never rewarded for a goal of theirs:
    vusfa evaluate, film, report and run read it as any other. It cannot be trained further.

    Args:
        checkpoint: of an agent with agent.shared_heads=true, or the folder of its run.
        rooms: bundled names, files, folders of them and patterns.
        folder: to write to; it must not hold a run.

    Raises:
        ConfigError: the agent has heads of its own per scene, the rooms do not fit it, or the folder holds a
            run.
        CheckpointError: the checkpoint cannot be read.
        SceneError: a room cannot be read.
    """
    target = check_folder(folder, "folder") / "checkpoint.pt"
    for path in (target, folder / "config.json"):
        if path.exists():
            raise ConfigError(f"folder is '{folder}', which holds a run ({path.name}); give another folder")
    agent, _, state = load_agent(checkpoint)
    scenes = SceneSet.open(rooms)
    moved = transplant(agent, scenes)
    sources = opened_from(scenes)
    config = settings_seen_from(folder, {**state["config"], "scenes": sources})
    state |= {
        "agent": moved.state_dict(),
        "agent_config": moved.config,
        "scenes": {
            "sources": scene_sources(sources, folder),
            "names": list(scenes.names),
            "fingerprint": scenes.fingerprint,
        },
        "goals": torch.empty(0, dtype=torch.int64),
        "config": config,
        "validation": dict(NO_VALIDATION),
        "optimizer": {"state": {}, "param_groups": []},
        "meter": {"episodes": {}, "terms": {}},
        **{name: {} for name in ("algorithm", "collector", "rng")},
    }
    save_checkpoint(target, {key: value for key, value in state.items() if key != "format"})
    write_json(folder / "config.json", config)
    say(f"next: vusfa evaluate {folder}, vusfa report {folder}, vusfa film {folder}")
    return target
