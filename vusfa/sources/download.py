"""Download of one large file over HTTP from servers that stall or drop the connection.

What has arrived is kept beside the target under a temporary name, with its address. A later
attempt, in this run or the next, asks the server for the rest only (``Range``), and only if the file there is
still the same (``If-Range``); a server that knows neither sends all of it again.
"""

from __future__ import annotations

import json
import queue
import shutil
import threading
import time
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

from vusfa.errors import ConfigError, SceneError
from vusfa.limits import FREE_BYTES, MAX_ARCHIVE_BYTES, brief
from vusfa.reading import read_json

__all__ = ["Patience", "download", "require_space"]

_BLOCK = 1 << 16
_PROGRESS = 1 << 12  # bytes that an attempt must bring to count as one that brought something
_MAX_REDIRECTS = 10


@dataclass(frozen=True)
class Patience:
    """Time limits and retries for a server.

    Args:
        connect: seconds until it must answer.
        silence: seconds without a byte after which a transfer has stalled; so has one of less than 64 KiB in
            twice that time.
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
    begins: bytes = b"",
    most: int = MAX_ARCHIVE_BYTES,
) -> None:
    """Download a file, resuming an earlier attempt; the target appears when it is complete.

    Args:
        url: where it is.
        target: file to write; beside it lie ``.NAME.part`` and ``.NAME.part.json`` until all has arrived.
        patience: when to try again, and when to give up.
        progress: called with bytes received and bytes in total (0 when the server does not say).
        sleep: waits between two tries.
        begins: first bytes of every such file; what begins otherwise is refused with its first block.
        most: bytes of the largest such file; a body that does not end is refused there.

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
            _transfer(requests, url, part, patience, progress or (lambda done, total: None), begins, most)
            part.finish()
            return
        except _Refused as refusal:
            raise SceneError(f"{url}: {refusal}; give another mirror") from refusal
        except requests.RequestException as error:
            if isinstance(error, ValueError):
                raise _no_address(url, error) from error
            # A transfer that breaks off after every few megabytes still gets there.
            failures = 1 if part.size >= before + _PROGRESS else failures + 1
            if failures >= patience.attempts:
                raise SceneError(
                    f"{url}: nothing arrives ({_why(error)}), {patience.attempts} times; try again later,"
                    f" what has come is kept, or give another mirror"
                ) from error
            sleep(patience.pause * 2 ** (failures - 1))
        except ValueError as error:  # urllib3 about a name of a host
            raise _no_address(url, error) from error
        except OSError as error:
            raise SceneError(f"{part.path}: cannot be written ({error}); check space and rights") from error


def _no_address(url: str, error: Exception) -> SceneError:
    return SceneError(f"{url}: is no address ({brief(str(error))}); give one like http://host/file.zip")


class _Refused(Exception):
    """An answer of the server for which a retry is useless."""


class _Part:
    """What has arrived of a file, and what the server called it."""

    def __init__(self, target: Path) -> None:
        self.target = target
        self.path = target.with_name(f".{target.name}.part")
        self._note = target.with_name(f".{target.name}.part.json")

    @property
    def size(self) -> int:
        """Bytes received."""
        return self.path.stat().st_size if self.path.exists() else 0

    def validator(self, url: str) -> str | None:
        """The ETag or date under which the server gave these bytes; None when they cannot be added to."""
        try:
            note = read_json(self._note, SceneError, "fetch it again")
        except SceneError:
            return None
        validator = note.get("validator") if note.get("url") == url and self.size else None
        return validator if isinstance(validator, str) else None

    def begin(self, url: str, validator: str | None) -> None:
        """Start with an empty file."""
        self.path.write_bytes(b"")
        self._note.write_text(json.dumps({"url": url, "validator": validator}))

    def finish(self) -> None:
        """Move the complete file to its target."""
        self.path.replace(self.target)
        self._note.unlink(missing_ok=True)

    def discard(self) -> None:
        """Delete what has arrived."""
        self.path.unlink(missing_ok=True)
        self._note.unlink(missing_ok=True)


def _transfer(
    requests: Any,
    url: str,
    part: _Part,
    patience: Patience,
    progress: Callable[[int, int], None],
    begins: bytes,
    most: int,
) -> None:
    """One connection: request what is missing, write it as it arrives.

    Raises requests' exceptions when the rest has to be asked for again.
    """
    validator = part.validator(url)
    # Without "identity" a server may compress on the way, and lengths mean nothing any more.
    headers = {"Accept-Encoding": "identity"}
    if validator is not None:
        headers |= {"Range": f"bytes={part.size}-", "If-Range": validator}
    with closing(_received(requests, url, headers, patience)) as stream:
        answer = next(stream)
        if answer.status_code == 416:  # beyond the end: what lies here is not what lies there
            part.discard()
            raise requests.ConnectionError("the server has another file now")
        if answer.status_code >= 500 or answer.status_code in (408, 429):
            raise requests.ConnectionError(f"the server answers {answer.status_code}")
        if answer.status_code not in (200, 206):
            raise _Refused(f"the server answers {answer.status_code} {answer.reason}")
        if answer.headers.get("Content-Encoding", "identity") != "identity":
            raise _Refused("the server sends it compressed, unasked")
        if answer.status_code == 200 or not _goes_on(answer, part.size):
            if answer.status_code == 206:
                part.discard()
                raise requests.ConnectionError("the server sent another part than was asked for")
            part.begin(url, _validator(answer))
        length = answer.headers.get("Content-Length", "")
        total = part.size + int(length) if length.isdecimal() and len(length) < 20 else 0
        done = part.size
        if total > most:
            raise _Refused(f"the file has {total} bytes, more than {most}")
        require_space(part.path.parent, total - done if total else 0)
        progress(done, total)
        with open(part.path, "ab") as file:
            for number, block in enumerate(stream):
                if done == 0 and block[: len(begins)] != begins[: len(block)]:
                    part.discard()
                    raise _Refused(f"the file begins with {brief(block[:16])}, not with {begins!r}")
                file.write(block)
                done += len(block)
                if done > most:
                    part.discard()
                    raise _Refused(f"the file has more than {most} bytes")
                if number % 256 == 0:
                    require_space(part.path.parent, 0)
                progress(done, total)
        if total and done != total:
            raise requests.ConnectionError(f"the connection ended after {done} of {total} bytes")


def require_space(folder: Path, size: int) -> None:
    """Refuse to write so many bytes into a folder whose disk would be full then.

    Raises:
        SceneError: there is less space than that and :data:`vusfa.limits.FREE_BYTES`.
    """
    free = shutil.disk_usage(folder).free
    if size + FREE_BYTES > free:
        raise SceneError(
            f"{folder}: {size} bytes are to be written, and its disk has {free} free; make space, leaving"
            f" {FREE_BYTES}, or give another folder"
        )


def _received(
    requests: Any, url: str, headers: dict[str, str], patience: Patience
) -> Generator[Any, None, None]:
    """The answer, then the blocks of its body.

    They come through a thread: a server that sends a byte now and then, in headers or body, keeps that thread
    waiting and nobody else.
    """
    arrived: queue.Queue[Any] = queue.Queue(maxsize=8)
    given_up = threading.Event()

    def put(item: Any) -> None:
        while not given_up.is_set():
            with suppress(queue.Full):
                return arrived.put(item, timeout=0.1)

    def receive() -> None:
        try:
            with _get(requests, url, headers, patience) as answer:
                put(answer)
                for block in answer.iter_content(_BLOCK):
                    put(block)
                    if given_up.is_set():
                        return
            put(None)
        except Exception as error:
            put(error)

    threading.Thread(target=receive, daemon=True).start()
    window = patience.connect + 2 * patience.silence
    begun, received = time.monotonic(), 0
    try:
        while True:
            item = arrived.get(timeout=max(0.0, begun + window - time.monotonic()))
            if isinstance(item, Exception):
                raise item
            if item is None:
                return
            yield item
            received += len(item) if isinstance(item, bytes) else _BLOCK
            if received >= _BLOCK:
                begun, received, window = time.monotonic(), 0, 2 * patience.silence
    except queue.Empty as error:
        raise requests.Timeout(f"less than {_BLOCK} bytes in {window:g} s") from error
    finally:
        given_up.set()


def _get(requests: Any, url: str, headers: dict[str, str], patience: Patience) -> Any:
    """The answer at the end of redirections. The bodies of those, which requests would read as a whole, are
    left alone."""
    session = requests.Session()
    target = session.get_redirect_target
    session.get_redirect_target = lambda answer: None
    for _ in range(_MAX_REDIRECTS):
        answer = session.get(url, headers=headers, stream=True, timeout=(patience.connect, patience.silence))
        place = target(answer)
        if not place:
            return answer
        answer.close()
        url = urljoin(url, place)
    raise requests.TooManyRedirects(f"more than {_MAX_REDIRECTS} redirections")


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
