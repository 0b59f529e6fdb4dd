"""Pictures of folders, streams and cameras, and what happens when they end, break off or are not there."""

from __future__ import annotations

import io
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from vusfa import limits
from vusfa.deploy import cameras
from vusfa.deploy.cameras import open_camera
from vusfa.deploy.pictures import as_picture
from vusfa.errors import CameraError, SceneError
from vusfa.sources.photos import fit_picture


def jpeg(level: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (20, 16), (level,) * 3).save(buffer, "JPEG")
    return buffer.getvalue()


def levels(pictures: Iterator[np.ndarray]) -> list[int]:
    return [int(picture[0, 0, 0]) for picture in pictures]


@pytest.fixture
def serve() -> Iterator[Callable[[Callable[[Any], None]], str]]:
    """Answers every request by a function of its handler; gives the address."""
    servers = []

    def start(answer: Callable[[Any], None]) -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                answer(self)

            def log_message(self, *_: Any) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        servers.append(server)
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        return f"http://127.0.0.1:{server.server_port}/video"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def stream(
    parts: list[bytes], kind: str = "multipart/x-mixed-replace; boundary=frame", wait: float = 0
) -> Any:
    def answer(handler: Any) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", kind)
        handler.end_headers()
        for part in parts:
            handler.wfile.write(part)
            handler.wfile.flush()
            time.sleep(wait)

    return answer


def part(body: bytes, length: bool) -> bytes:
    head = b"--frame\r\nContent-Type: image/jpeg\r\n" + b"Content-Length: %d\r\n" % len(body) * length
    return head + b"\r\n" + body + b"\r\n"


def test_a_folders_pictures_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        (tmp_path / f"{number}.jpg").write_bytes(jpeg(20 * number))
    (tmp_path / "notes.txt").touch()
    (tmp_path / ".hidden.jpg").touch()
    assert levels(open_camera(str(tmp_path))) == [20, 40, 200]
    (tmp_path / "3.jpg").write_bytes(jpeg(0)[:100])
    pictures = open_camera(str(tmp_path))
    assert [int(next(pictures)[0, 0, 0]) for _ in range(2)] == [20, 40]
    with pytest.raises(SceneError, match=r"3\.jpg: is no picture that can be read"):
        next(pictures)


@pytest.mark.parametrize("length", [True, False])
def test_a_streams_parts_are_cut_apart(serve: Any, length: bool) -> None:
    sent = [part(jpeg(level), length) for level in (10, 90, 200)]
    joined = b"".join(sent) + b"--frame--\r\n"
    pieces = [joined[k : k + 100] for k in range(0, len(joined), 100)]  # as networks cut them
    response = cameras._open(cameras.build_opener(cameras.ProxyHandler({})), serve(stream(pieces)))
    assert list(cameras._parts(response, "x")) == [jpeg(level) for level in (10, 90, 200)]


def test_a_stream_gives_the_newest_picture(serve: Any) -> None:
    sent, go = [part(jpeg(level), True) for level in range(0, 200, 10)], threading.Event()

    def answer(handler: Any) -> None:
        stream(sent[:1])(handler)
        go.wait(10)
        for one in sent[1:]:
            handler.wfile.write(one)

    address = serve(answer)
    pictures = open_camera(address)
    assert next(pictures)[0, 0, 0] == 0
    go.set()
    (thread,) = (thread for thread in threading.enumerate() if thread.name == f"camera {address}")
    thread.join(10)  # until all others have come
    assert levels(pictures) == [190]


def test_a_snapshot_is_fetched_anew_each_time(serve: Any) -> None:
    asked: list[int] = []

    def answer(handler: Any) -> None:
        asked.append(0)
        stream([jpeg(50 * len(asked))], "image/jpeg")(handler)

    pictures = open_camera(serve(answer))
    assert [int(next(pictures)[0, 0, 0]) for _ in range(3)] == [50, 100, 150]


def test_cameras_that_are_not_there_or_send_no_pictures_are_one_line(
    serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}/"
    with pytest.raises(CameraError, match=r"cannot be reached \(.*refused.*\); check the address"):
        open_camera(address)
    with pytest.raises(CameraError, match="HTTP Error 404"):
        open_camera(serve(lambda handler: handler.send_error(404)))
    with pytest.raises(CameraError, match=r"sends 'text/html'; give the address of an MJPEG stream"):
        open_camera(serve(stream([b"<html>"], "text/html")))
    with pytest.raises(CameraError, match="names no boundary"):
        next(open_camera(serve(stream([b"x"], "multipart/x-mixed-replace"))))
    with pytest.raises(SceneError, match=r"/video: is no picture that can be read"):
        next(open_camera(serve(stream([part(b"none", True)]))))
    monkeypatch.setattr(limits, "MAX_STREAM_PICTURE_BYTES", 1000)
    with pytest.raises(CameraError, match="a picture has more than 1000 bytes"):
        next(open_camera(serve(stream([b"--frame\r\n\r\n" + bytes(9000)]))))
    monkeypatch.setattr(cameras, "_TIMEOUT", 0.1)
    with pytest.raises(CameraError, match=r"sent no picture for 0 seconds|broke off \(timed out\)"):
        next(open_camera(serve(stream([b"--frame"], wait=0.5))))
    with pytest.raises(CameraError, match="the folder has no pictures"):
        open_camera(str(tmp_path))
    for source in ("http:/host", "-1", "film.mp4"):
        with pytest.raises(CameraError, match="no such folder or film"):
            open_camera(source)


@pytest.mark.parametrize("source", ["0", "film"])
def test_opencvs_pictures_are_turned_to_rgb_until_they_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, source: str
) -> None:
    frames = [np.full((4, 5, 3), (1, 2, level), np.uint8) for level in (30, 60)]
    released = []

    class Capture:
        def __init__(self, source: Any) -> None:
            self.source, self.left = source, list(frames)

        def isOpened(self) -> bool:
            return self.source not in (7, "bad.mp4")

        def read(self) -> tuple[bool, Any]:
            return (True, self.left.pop(0)) if self.left else (False, None)

        def release(self) -> None:
            released.append(self.source)

    fake = SimpleNamespace(
        VideoCapture=Capture,
        COLOR_BGR2RGB=4,
        cvtColor=lambda picture, _: picture[..., ::-1],
    )
    monkeypatch.setitem(sys.modules, "cv2", fake)
    (tmp_path / "film").touch()
    monkeypatch.chdir(tmp_path)
    found = list(open_camera(source))
    assert found[-1][0, 0].tolist() == [60, 2, 1]
    assert len(found) == 2 or source == "0"  # a camera's older pictures are left out
    assert released == [0 if source == "0" else "film"]
    (tmp_path / "bad.mp4").touch()
    with pytest.raises(CameraError, match=r"camera 'bad.mp4': cannot be opened; it is no film"):
        open_camera("bad.mp4")
    with pytest.raises(CameraError, match=r"camera '7': cannot be opened; check its number"):
        open_camera("7")
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(CameraError, match="need OpenCV: pip install opencv-python-headless"):
        open_camera("0")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_goals_and_pictures_of_a_folder_are_regular_files(tmp_path: Path, kind: str) -> None:
    """A pipe would be waited for, a device never ends."""
    place = tmp_path / "a.jpg"
    if kind == "pipe":
        os.mkfifo(place)
    elif kind == "device":
        place.symlink_to("/dev/zero")
    else:
        place.mkdir()
    with pytest.raises(SceneError, match=r"a\.jpg: cannot be read \(it is no regular file\)"):
        as_picture(place)
    with pytest.raises(SceneError, match=r"a\.jpg: cannot be read \(it is no regular file\)"):
        next(open_camera(str(tmp_path)))
    with pytest.raises(OSError, match="it is no regular file"):
        fit_picture(place, 8, 8)
