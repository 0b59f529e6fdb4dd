"""Trained agents on a model hub, with the mixin of huggingface_hub: ``pip install 'vusfa[hub]'``.

Data are sent or fetched only by :meth:`HubAgent.push_to_hub` and :meth:`HubAgent.from_pretrained`. A
repository holds ``agent.safetensors`` (:mod:`vusfa.deploy.agents`) and the model card as ``README.md``.
"""

from __future__ import annotations

import os
import queue
import threading
from pathlib import Path
from typing import Any

from vusfa.deploy.agents import TrainedAgent, open_agent, read_agent, save_agent
from vusfa.errors import CheckpointError, ConfigError, SceneError
from vusfa.limits import brief
from vusfa.reading import read_text
from vusfa.scenes import SceneSet

try:
    from huggingface_hub import ModelHubMixin, hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
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
    def from_pretrained(  # type: ignore[override]
        cls, source: str | Path, *, scenes: SceneSet | None = None, patience: float = 600.0, **options: Any
    ) -> HubAgent:
        """Load an agent from a hub or from a folder of ``save_pretrained``.

        The mixin's own method would read a ``config.json`` first, which agents do not have.

        Args:
            source: ``OWNER/NAME`` on the hub, or a folder.
            scenes: the rooms that the agent was trained in, when they are not bundled.
            patience: seconds that each of the two files may take; a server may also send a byte now and then.
            options: of ``huggingface_hub.hf_hub_download``: ``revision``, ``cache_dir``, ``force_download``,
                ``token``, ``local_files_only``.

        Raises:
            CheckpointError: there is no such agent, it cannot be fetched, or a file is damaged.
            SceneError: its rooms are not here.
        """
        path, card = (
            Path(source, name) if os.path.isdir(source) else _fetched(str(source), name, patience, options)
            for name in (_FILE, _CARD)
        )
        if path is None:
            raise CheckpointError(f"{source}: has no {_FILE}; it is no agent of vusfa")
        try:
            found = read_agent(path, scenes)
        except SceneError as error:
            raise SceneError(
                f"{error}; a hub has no rooms: give them as scenes=SceneSet.open(...)"
            ) from error
        if card is None or not card.is_file():
            return cls(found)
        text = read_text(card, CheckpointError, "write the model card again as UTF-8, or remove it")
        return cls(found._replace(card=text))


def _fetched(source: str, name: str, patience: float, options: dict[str, Any]) -> Path | None:
    """A file of a repository in the cache; None when the repository is there without it."""
    found: queue.Queue[Any] = queue.Queue()

    def fetch() -> None:
        try:
            found.put(hf_hub_download(source, name, **options))
        except BaseException as error:
            found.put(error)

    # the library's own limits are of each read: in a thread, a server that drips keeps nobody else waiting
    threading.Thread(target=fetch, daemon=True).start()
    try:
        result = found.get(timeout=patience)
        if isinstance(result, BaseException):
            raise result
        return Path(result)
    except queue.Empty as error:
        raise CheckpointError(
            f"{source[:200]}: {name} has not arrived within {patience:g} s; check the connection, or give"
            " more patience="
        ) from error
    except Exception as error:  # whatever a server says and the library makes of it
        if isinstance(error, EntryNotFoundError) and not isinstance(error, LocalEntryNotFoundError):
            return None
        reason = brief(" ".join(str(error).split()) or type(error).__name__)
        raise CheckpointError(
            f"{source[:200]}: cannot be fetched ({name}: {reason}); check its name and the connection"
        ) from error
