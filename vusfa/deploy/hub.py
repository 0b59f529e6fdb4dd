"""Trained agents on a model hub, with the mixin of huggingface_hub: ``pip install 'vusfa[hub]'``.

Data are sent or fetched only by :meth:`HubAgent.push_to_hub` and :meth:`HubAgent.from_pretrained`. A
repository holds ``agent.safetensors`` (:mod:`vusfa.deploy.agents`) and the model card as ``README.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vusfa.deploy.agents import TrainedAgent, open_agent, read_agent, save_agent
from vusfa.errors import CheckpointError, ConfigError, SceneError
from vusfa.scenes import SceneSet

try:
    from huggingface_hub import ModelHubMixin, hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, LocalEntryNotFoundError
except ModuleNotFoundError as error:
    raise ConfigError("model hubs need huggingface_hub: pip install 'vusfa[hub]'") from error

__all__ = ["HubAgent"]

_FILE, _CARD = "agent.safetensors", "README.md"
_PLAIN_CARD = """---
library_name: vusfa
pipeline_tag: reinforcement-learning
---

An agent of vusfa, without numbers.
"""


class HubAgent(ModelHubMixin, library_name="vusfa"):
    """A trained agent with ``save_pretrained``, ``push_to_hub`` and ``from_pretrained``.

    Args:
        trained: agent, rooms, goals and card. Rooms are not sent: ``from_pretrained(name, scenes=...)`` takes
            those that are not bundled.

    >>> import tempfile
    >>> from vusfa.deploy import load_pretrained
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     HubAgent(load_pretrained("gvf")).save_pretrained(folder)
    ...     HubAgent.from_pretrained(folder).trained.agent.config["model"]
    'gvf'
    """

    def __init__(self, trained: TrainedAgent) -> None:
        self.trained = trained

    @classmethod
    def open(cls, source: str | Path) -> HubAgent:
        """Load the agent of a checkpoint, a safetensors file or a pretrained name."""
        return cls(open_agent(source))

    def _save_pretrained(self, save_directory: Path) -> None:
        agent, scenes, goals, card = self.trained
        save_agent(save_directory / _FILE, agent, scenes, goals)
        (save_directory / _CARD).write_text(card or _PLAIN_CARD, encoding="utf-8")

    @classmethod
    def _from_pretrained(cls, *, model_id: str, scenes: SceneSet | None = None, **options: Any) -> HubAgent:
        folder = Path(model_id)
        if folder.is_dir():
            path, card = folder / _FILE, folder / _CARD
        else:
            kept = {
                key: options[key]
                for key in ("revision", "cache_dir", "force_download", "token", "local_files_only")
            }
            try:
                path, card = (Path(hf_hub_download(model_id, name, **kept)) for name in (_FILE, _CARD))
            except EntryNotFoundError as error:
                raise CheckpointError(f"{model_id}: has no {_FILE}; it is no agent of vusfa") from error
            except (HfHubHTTPError, LocalEntryNotFoundError, OSError) as error:
                reason = str(error).strip().splitlines()[0]
                raise CheckpointError(f"{model_id}: cannot be fetched ({reason}); check its name") from error
        try:
            found = read_agent(path, scenes)
        except SceneError as error:
            raise SceneError(
                f"{error}; a hub has no rooms: give them as scenes=SceneSet.open(...)"
            ) from error
        return cls(found._replace(card=card.read_text(encoding="utf-8") if card.is_file() else ""))
