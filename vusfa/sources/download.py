"""One large file over HTTP from servers that stall, break off and come back.

What has arrived lies beside the target under a temporary name, with a note of where it came from. A later
attempt, in this run or the next, asks the server for the rest only (``Range``), and only if the file there is
still the same (``If-Range``); a server that knows neither sends all of it again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vusfa.errors import ConfigError, SceneError

__all__ = ["Patience", "download"]

_BLOCK = 1 << 16


@dataclass(frozen=True)
class Patience:
    """How long to bear with a server.

    Args:
        connect: seconds until it must answer.
        silence: seconds without a byte after which a transfer has stalled.
        attempts: tries at one address that bring nothing new, after which the next address is asked.
        pause: seconds before the second try, doubled before every further one.
    """

    connect: float = 15.0
    silence: float = 30.0
    attempts: int = 5
    pause: float = 1.0


def download(
    url: str,
    target: Path,
    patience: Patience,
    progress: Callable[[int, int], None] | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Fetch a file, going on with what arrived before; the target appears when it is whole.

    Args:
        url: where it is.
        target: file to write; beside it lie ``.NAME.part`` and ``.NAME.part.json`` until all has arrived.
        patience: when to try again, and when to give up.
        progress: called with bytes there and bytes in all (0 when the server does not say).
        sleep: waits between two tries.

    Raises:
        SceneError: nothing new came in ``patience.attempts`` tries, or the server refuses; what has arrived
            stays for the next time.
    """
    requests = _requests()
    part = _Part(target)
    failures = 0
    while True:
        before = part.size
        try:
            _transfer(requests, url, part, patience, progress or (lambda done, total: None))
            part.finish()
            return
        except _Refused as refusal:
            raise SceneError(f"{url}: {refusal}; give another mirror") from refusal
        except _never(requests) as error:
            raise SceneError(f"{url}: is no address ({error}); give one like http://host/file.zip") from error
        except requests.RequestException as error:
            # A transfer that breaks off after every few megabytes still gets there.
            failures = 1 if part.size > before else failures + 1
            if failures >= patience.attempts:
                raise SceneError(
                    f"{url}: nothing arrives ({_why(error)}), {patience.attempts} times; try again later,"
                    f" what has come is kept, or give another mirror"
                ) from error
            sleep(patience.pause * 2 ** (failures - 1))
        except OSError as error:
            raise SceneError(f"{part.path}: cannot be written ({error}); check space and rights") from error


def _never(requests: Any) -> tuple[type[Exception], ...]:
    wrong = requests.exceptions
    return (wrong.InvalidURL, wrong.MissingSchema, wrong.InvalidSchema)


class _Refused(Exception):
    """The server's answer will not change by asking again."""


class _Part:
    """What has arrived of a file, and what the server called it."""

    def __init__(self, target: Path) -> None:
        self.target = target
        self.path = target.with_name(f".{target.name}.part")
        self._note = target.with_name(f".{target.name}.part.json")

    @property
    def size(self) -> int:
        """Bytes there."""
        return self.path.stat().st_size if self.path.exists() else 0

    def validator(self, url: str) -> str | None:
        """The ETag or date under which the server gave these bytes; None when they cannot be added to."""
        try:
            note = json.loads(self._note.read_text())
        except (OSError, ValueError):
            return None
        return note.get("validator") if note.get("url") == url and self.size else None

    def begin(self, url: str, validator: str | None) -> None:
        """Start from nothing."""
        self.path.write_bytes(b"")
        self._note.write_text(json.dumps({"url": url, "validator": validator}))

    def finish(self) -> None:
        """All is there."""
        self.path.replace(self.target)
        self._note.unlink(missing_ok=True)

    def discard(self) -> None:
        """None of it is of use."""
        self.path.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)


def _transfer(
    requests: Any, url: str, part: _Part, patience: Patience, progress: Callable[[int, int], None]
) -> None:
    """One connection: ask for what is missing, write it as it comes.

    Raises requests' exceptions when the rest has to be asked for again.
    """
    validator = part.validator(url)
    # Without "identity" a server may compress on the way, and lengths mean nothing any more.
    headers = {"Accept-Encoding": "identity"}
    if validator is not None:
        headers |= {"Range": f"bytes={part.size}-", "If-Range": validator}
    limits = (patience.connect, patience.silence)
    with requests.get(url, headers=headers, stream=True, timeout=limits) as answer:
        if answer.status_code == 416:  # beyond the end: what lies here is not what lies there
            part.discard()
            raise requests.ConnectionError("the server has another file now")
        if answer.status_code >= 500 or answer.status_code in (408, 429):
            raise requests.ConnectionError(f"the server answers {answer.status_code}")
        if answer.status_code not in (200, 206):
            raise _Refused(f"the server answers {answer.status_code} {answer.reason}")
        if answer.status_code == 200 or not _goes_on(answer, part.size):
            if answer.status_code == 206:
                part.discard()
                raise requests.ConnectionError("the server sent another part than was asked for")
            part.begin(url, _validator(answer))
        length = answer.headers.get("Content-Length")
        total = part.size + int(length) if length and length.isdigit() else 0
        done = part.size
        progress(done, total)
        with open(part.path, "ab") as file:
            for block in answer.iter_content(_BLOCK):
                file.write(block)
                done += len(block)
                progress(done, total)
        if total and done != total:
            raise requests.ConnectionError(f"the connection ended after {done} of {total} bytes")


def _goes_on(answer: Any, have: int) -> bool:
    return answer.headers.get("Content-Range", "").replace("=", " ").startswith(f"bytes {have}-")


def _validator(answer: Any) -> str | None:
    """What names this version of the file: a strong ETag, else its date."""
    tag = answer.headers.get("ETag")
    if tag and not tag.startswith("W/"):
        return tag
    return answer.headers.get("Last-Modified")


def _why(error: Exception) -> str:
    """The innermost reason, without the layers that urllib3 wraps around it."""
    inner = error
    while inner.args and isinstance(inner.args[-1], Exception):
        inner = inner.args[-1]
    reason = getattr(inner, "reason", None)
    return str(reason if isinstance(reason, Exception) else inner) or type(inner).__name__


def _requests() -> Any:
    try:
        import requests
    except ModuleNotFoundError as error:
        raise ConfigError("fetching needs a package that is missing: pip install 'vusfa[scenes]'") from error
    return requests
