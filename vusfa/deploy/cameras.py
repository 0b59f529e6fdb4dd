"""Streams of pictures: from a folder, a film, a camera, or an http address."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Generator, Iterator
from contextlib import closing
from email.message import Message
from http.client import HTTPException
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import OpenerDirector, ProxyHandler, build_opener

import numpy as np

from vusfa import limits
from vusfa.deploy.pictures import decode_upright, read_upright
from vusfa.errors import CameraError
from vusfa.limits import brief

__all__ = ["open_camera"]

_ENDINGS = (".jpg", ".jpeg", ".png")
_TIMEOUT = 10.0  # seconds


def open_camera(source: str) -> Iterator[np.ndarray]:
    """Open a source of pictures, (H, W, 3) uint8 each.

    Folders and films give all pictures in order. Cameras and streams give the newest picture on each request
    and drop those in between.

    Args:
        source: a folder of JPEG and PNG files, read in the order of their names (2 before 10); a number, that
            of a camera in OpenCV; a film, read with OpenCV; or an http address of an MJPEG stream or of
            a single picture, which is then fetched again each time.

    Raises:
        CameraError: there is no such source, it cannot be reached, or OpenCV is missing.
        SceneError: a file of the folder is no picture.

    >>> open_camera("no/such/folder")
    Traceback (most recent call last):
    ...
    vusfa.errors.CameraError: camera 'no/such/folder': no such folder or film; give a folder of pictures, a
        camera's number, or an http address
    """
    if re.fullmatch(r"\d+", source):
        return _opencv(int(source), source)
    if re.match(r"(?i)https?://", source):
        return _http(source)
    path = Path(source)
    if path.is_dir():
        return _folder(path)
    if path.is_file():
        return _opencv(source, source)
    raise CameraError(
        f"camera {brief(source)}: no such folder or film; give a folder of pictures, a camera's number, or an"
        " http address"
    )


def _folder(path: Path) -> Iterator[np.ndarray]:
    files = [file for file in path.iterdir() if file.suffix.lower() in _ENDINGS and file.name[0] != "."]
    if not files:
        raise CameraError(
            f"camera {str(path)!r}: the folder has no pictures; they end in {', '.join(_ENDINGS)}"
        )
    files.sort(
        key=lambda file: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", file.name)]
    )
    return (read_upright(file) for file in files)


def _opencv(source: int | str, name: str) -> Iterator[np.ndarray]:
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # faults are raised here instead
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    try:
        cv2 = import_module("cv2")
    except ModuleNotFoundError as error:
        raise CameraError(
            f"camera {brief(name)}: cameras and films need OpenCV: pip install opencv-python-headless"
        ) from error
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        capture.release()
        mend = "check its number, or whether it is in use"
        if isinstance(source, str):
            mend = "it is no film that OpenCV reads"
        raise CameraError(f"camera {brief(name)}: cannot be opened; {mend}")
    if isinstance(source, str):
        return _of_film(cv2, capture)
    return _newest(_of_film(cv2, capture), name)


def _of_film(cv2: Any, capture: Any) -> Generator[np.ndarray, None, None]:
    try:
        while True:
            there, picture = capture.read()
            if not there:
                return
            yield cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    finally:
        capture.release()


def _http(address: str) -> Iterator[np.ndarray]:
    opener = build_opener(ProxyHandler({}))  # cameras are in the local network
    response = _open(opener, address)
    kind = response.headers.get_content_type()
    if kind == "multipart/x-mixed-replace":
        return _newest(_of_stream(response, address), address)
    if kind in ("image/jpeg", "image/png"):
        return _snapshots(opener, address, response)
    response.close()
    raise CameraError(
        f"camera {address}: sends {brief(kind)}; give the address of an MJPEG stream or of a JPEG"
    )


def _open(opener: OpenerDirector, address: str) -> Any:
    try:
        return opener.open(address, timeout=_TIMEOUT)
    except (OSError, HTTPException, ValueError) as error:
        reason = getattr(error, "reason", error)
        if isinstance(error, HTTPError):
            error.close()
            reason = str(error)
        raise CameraError(f"camera {address}: cannot be reached ({reason}); check the address") from error


def _snapshots(opener: OpenerDirector, address: str, response: Any) -> Iterator[np.ndarray]:
    while True:
        with response:
            yield decode_upright(_read(response, address), address)
        response = _open(opener, address)


def _of_stream(response: Any, address: str) -> Generator[np.ndarray, None, None]:
    with closing(_parts(response, address)) as parts:
        for part in parts:
            yield decode_upright(part, address)


def _check_size(content: bytes, address: str) -> None:
    most = limits.MAX_STREAM_PICTURE_BYTES
    if len(content) > most:
        raise CameraError(f"camera {address}: a picture has more than {most} bytes; make them smaller")


def _read(response: Any, address: str) -> bytes:
    try:
        content = response.read(limits.MAX_STREAM_PICTURE_BYTES + 1)
    except (OSError, HTTPException) as error:
        raise CameraError(f"camera {address}: broke off ({error}); start again") from error
    _check_size(content, address)
    return content


def _parts(response: Any, address: str) -> Generator[bytes, None, None]:
    """Bodies of the parts of a multipart stream."""
    headers: Message = response.headers
    boundary = headers.get_param("boundary")
    if not isinstance(boundary, str) or not boundary.strip("-"):
        response.close()
        raise CameraError(
            f"camera {address}: its stream names no boundary between pictures; use another address"
        )
    mark, buffer = b"--" + boundary.removeprefix("--").encode(), b""
    with response:
        while True:
            try:
                chunk = response.read1(1 << 16)
            except (OSError, HTTPException) as error:
                raise CameraError(f"camera {address}: broke off ({error}); start again") from error
            buffer += chunk
            while (part := _first_part(buffer, mark, not chunk)) is not None:
                body, buffer = part
                if body:
                    yield body
            if not chunk:
                return
            _check_size(buffer, address)


def _first_part(buffer: bytes, mark: bytes, ended: bool) -> tuple[bytes, bytes] | None:
    """Body of the first complete part, and the bytes after it; None while no part is complete."""
    _, found, rest = buffer.partition(mark)
    top, gap, body = rest.partition(b"\r\n\r\n")
    if not found or not gap:
        return None
    length = re.search(rb"(?im)^content-length:\s*(\d+)\s*$", top)
    if length:
        size = int(length[1])
        return (body[:size], body[size:]) if len(body) >= size else None
    picture, found, _ = body.partition(mark)
    if found or (ended and body):
        return picture.removesuffix(b"\r\n"), body[len(picture) :]
    return None


def _newest(pictures: Generator[np.ndarray, None, None], name: str) -> Iterator[np.ndarray]:
    """Newest picture of a live source on each request; a thread drops the others."""
    arrived, stop = threading.Condition(), threading.Event()
    slot: list[Any] = [None, False, None]  # picture, whether it ended, fault

    def take() -> None:
        fault: Exception | None = None
        try:
            with closing(pictures):
                for picture in pictures:
                    with arrived:
                        slot[0] = picture
                        arrived.notify()
                    if stop.is_set():
                        break
        except Exception as error:
            fault = error
        with arrived:
            slot[1], slot[2] = True, fault
            arrived.notify()

    thread = threading.Thread(target=take, name=f"camera {name}", daemon=True)
    thread.start()
    try:
        while True:
            with arrived:
                if not arrived.wait_for(lambda: slot[0] is not None or slot[1], _TIMEOUT):
                    raise CameraError(
                        f"camera {name}: sent no picture for {_TIMEOUT:.0f} seconds; start it again"
                    )
                picture, slot[0] = slot[0], None
            if picture is None:
                if slot[2] is not None:
                    raise slot[2]
                return
            yield picture
    finally:
        stop.set()
