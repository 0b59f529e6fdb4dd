"""Fetching from a local server that stalls, breaks off, lies and refuses; nothing else is ever asked."""

from __future__ import annotations

import io
import struct
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import h5py
import pytest

from vusfa.errors import ConfigError, SceneError
from vusfa.sources.download import Patience, download
from vusfa.sources.fetch import Archive, archives, fetch

QUICK = Patience(connect=2, silence=0.3, attempts=3, pause=0.01)


class Server:
    """Serves one file; ``mood`` lists what it does to the next requests, one each; then it behaves."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.etag: str | None = '"one"'
        self.ranges = True
        self.mood: list[str] = []
        self.asked: list[str | None] = []  # the Range of every request
        self.sent = 0
        self.release = threading.Event()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                outer.answer(self)

            def log_message(self, format: str, *arguments: object) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        self.thread = threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.02})
        self.thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.http.server_port}/file.zip"

    def close(self) -> None:
        self.release.set()
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        mood = self.mood.pop(0) if self.mood else "well"
        wanted = request.headers.get("Range")
        self.asked.append(wanted)
        if mood.isdigit():
            request.send_error(int(mood))
            return
        if mood in ("endless", "drip", "dripping head", "endless redirection"):
            self.misbehave(request, mood)
            return
        first = 0
        if self.ranges and wanted and request.headers.get("If-Range") == self.etag:
            first = int(wanted.removeprefix("bytes=").rstrip("-"))
        if first > len(self.content) or mood == "beyond":
            request.send_error(416)
            return
        body = self.content[first:]
        request.send_response(206 if first else 200)
        if first:
            shown = 0 if mood == "other part" else first
            request.send_header("Content-Range", f"bytes {shown}-{len(self.content) - 1}/{len(self.content)}")
        if self.etag:
            request.send_header("ETag", self.etag)
        request.send_header("Content-Length", str(len(body)))
        request.end_headers()
        if mood == "corrupt":
            middle = len(body) // 2
            body = (
                body[:middle]
                + bytes(byte ^ 0xFF for byte in body[middle : middle + 64])
                + body[middle + 64 :]
            )
        if mood in ("stall", "truncate"):
            body = body[: (len(body) * 3) // 4]
        if mood == "silent":
            body = b""
        request.wfile.write(body)
        request.wfile.flush()
        self.sent += len(body)
        if mood in ("stall", "silent"):
            self.release.wait(5)

    def misbehave(self, request: BaseHTTPRequestHandler, mood: str) -> None:
        """Send something without an end, until nobody listens any more."""
        request.send_response(302 if mood == "endless redirection" else 200)
        request.send_header("Location", self.url)
        if mood != "dripping head":
            request.end_headers()
        block = b"x" * (1 if "drip" in mood else 1 << 16)
        with suppress(OSError):
            request.wfile.write(b"X-Long: " if mood == "dripping head" else self.content[:4])
            while not self.release.wait(0.02 if "drip" in mood else 0):
                request.wfile.write(block)
                self.sent += len(block)


@pytest.fixture
def serve() -> Iterator[Callable[[bytes], Server]]:
    servers: list[Server] = []

    def start(content: bytes) -> Server:
        servers.append(Server(content))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


# Several blocks, so that most of it is on the disk when a transfer ends early.
CONTENT = bytes(range(256)) * 4000


def hidden(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


# ---- one file


def test_a_file_arrives_with_progress(serve: Callable, tmp_path: Path) -> None:
    server, seen = serve(CONTENT), []
    download(server.url, tmp_path / "f", QUICK, lambda done, total: seen.append((done, total)))
    assert (tmp_path / "f").read_bytes() == CONTENT
    assert seen[0] == (0, len(CONTENT))
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert seen == sorted(seen)
    assert hidden(tmp_path) == []


@pytest.mark.parametrize("mood", ["stall", "truncate"])
def test_a_transfer_that_breaks_off_goes_on_where_it_was(serve: Callable, tmp_path: Path, mood: str) -> None:
    server = serve(CONTENT)
    server.mood = [mood, mood]
    download(server.url, tmp_path / "f", QUICK)
    assert (tmp_path / "f").read_bytes() == CONTENT
    first, second, third = server.asked
    assert first is None
    starts = [int(str(asked).removeprefix("bytes=").rstrip("-")) for asked in (second, third)]
    assert 0 < starts[0] <= len(CONTENT) * 3 / 4
    assert starts[0] < starts[1] < len(CONTENT)
    assert server.sent < 1.6 * len(CONTENT)  # not three times three quarters


def test_a_run_that_was_stopped_is_taken_up_by_the_next(serve: Callable, tmp_path: Path) -> None:
    server = serve(CONTENT)

    def stop(done: int, total: int) -> None:
        if done > len(CONTENT) / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download(server.url, tmp_path / "f", QUICK, stop)
    assert not (tmp_path / "f").exists()
    seen: list[int] = []
    download(server.url, tmp_path / "f", QUICK, lambda done, total: seen.append(done))
    assert (tmp_path / "f").read_bytes() == CONTENT
    assert seen[0] >= len(CONTENT) / 2
    assert hidden(tmp_path) == []


def test_a_server_that_always_breaks_off_still_gets_there(serve: Callable, tmp_path: Path) -> None:
    server, pauses = serve(CONTENT), []
    server.mood = ["truncate"] * 3  # as many as the attempts, but each brings something new
    download(server.url, tmp_path / "f", QUICK, sleep=pauses.append)
    assert (tmp_path / "f").read_bytes() == CONTENT
    assert pauses == [0.01] * 3


def test_what_one_address_gave_is_not_joined_with_another(serve: Callable, tmp_path: Path) -> None:
    one, two = serve(CONTENT), serve(CONTENT[::-1])
    with pytest.raises(SceneError):
        _until_it_fails(one, tmp_path)
    download(two.url, tmp_path / "f", QUICK)
    assert (tmp_path / "f").read_bytes() == CONTENT[::-1]
    assert two.asked == [None]


def test_a_weak_etag_does_not_name_the_bytes(serve: Callable, tmp_path: Path) -> None:
    server = serve(CONTENT)
    server.etag, server.mood = 'W/"one"', ["truncate"]
    download(server.url, tmp_path / "f", QUICK)
    assert server.asked == [None, None]


@pytest.mark.parametrize("change", ["etag", "no ranges", "no etag", "beyond", "other part"])
def test_parts_of_different_files_are_never_joined(serve: Callable, tmp_path: Path, change: str) -> None:
    server = serve(CONTENT)
    if change == "no etag":
        server.etag = None
    server.mood = ["truncate"] * QUICK.attempts
    quick = Patience(connect=2, silence=0.3, attempts=1, pause=0.01)
    with pytest.raises(SceneError, match="nothing arrives"):
        download(server.url, tmp_path / "f", quick) if change == "no etag" else _until_it_fails(
            server, tmp_path
        )
    new = CONTENT[::-1]
    server.content, server.mood = new, []
    if change == "etag":
        server.etag = '"two"'
    elif change == "no ranges":
        server.ranges = False
    elif change in ("beyond", "other part"):
        server.mood = [change]
    download(server.url, tmp_path / "f", QUICK)
    assert (tmp_path / "f").read_bytes() == new


def _until_it_fails(server: Server, folder: Path) -> None:
    """One truncated transfer, then three in which nothing comes."""
    server.mood = ["truncate"] + ["503"] * QUICK.attempts
    download(server.url, folder / "f", QUICK)


def test_a_dead_server_is_given_up_after_the_attempts_with_growing_pauses(
    serve: Callable, tmp_path: Path
) -> None:
    server, pauses = serve(CONTENT), []
    server.mood = ["503", "silent", "429"]
    with pytest.raises(SceneError, match=r"nothing arrives .* 3 times; try again later"):
        download(server.url, tmp_path / "f", QUICK, sleep=pauses.append)
    assert pauses == [0.01, 0.02]


@pytest.mark.parametrize("status", ["404", "403"])
def test_a_refusal_is_not_repeated(serve: Callable, tmp_path: Path, status: str) -> None:
    server = serve(CONTENT)
    server.mood = [status]
    with pytest.raises(SceneError, match=f"answers {status}.*another mirror"):
        download(server.url, tmp_path / "f", QUICK)
    assert len(server.asked) == 1


@pytest.mark.parametrize(
    "url",
    ["no-scheme", "gopher://127.0.0.1/x", "http://" + "a" * 300 + ".com/x", "http://a..b/x", "http://[::1/x"],
)
def test_what_is_no_address_is_said_at_once(tmp_path: Path, url: str) -> None:
    with pytest.raises(SceneError, match="is no address"):
        download(url, tmp_path / "f", QUICK, sleep=lambda seconds: pytest.fail("waited"))


@pytest.mark.parametrize("mood", ["drip", "dripping head"])
def test_a_server_that_drips_is_given_up(serve: Callable, tmp_path: Path, mood: str) -> None:
    server = serve(CONTENT)
    server.mood = [mood]
    with pytest.raises(SceneError, match=r"nothing arrives \(less than 65536 bytes in"):
        download(server.url, tmp_path / "f", Patience(connect=0.2, silence=0.1, attempts=1, pause=0.01))


def test_a_file_without_end_is_given_up(serve: Callable, tmp_path: Path) -> None:
    server = serve(CONTENT)
    server.mood = ["endless"]
    with pytest.raises(SceneError, match=r"the file has more than 1048576 bytes; give another mirror"):
        download(server.url, tmp_path / "f", QUICK, most=1 << 20)
    assert hidden(tmp_path) == []


def test_a_zip_without_end_is_given_up_at_the_size_of_its_scenes(
    serve: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vusfa.sources.fetch.MAX_STATE_BYTES", 1 << 16)
    server = serve(b"PK\3\4" + CONTENT)
    server.mood = ["endless"]
    with pytest.raises(SceneError, match=r"the file has more than 655360 bytes; give another mirror"):
        fetch(described(server.url), tmp_path / "scenes")
    assert names(tmp_path / "scenes") == []
    with pytest.raises(
        SceneError, match=r"the file has 1024004 bytes, more than 655360; give another mirror"
    ):
        fetch(described(server.url), tmp_path / "scenes")


def test_the_endless_body_of_a_redirection_is_not_read(serve: Callable, tmp_path: Path) -> None:
    server = serve(CONTENT)
    server.mood = ["endless redirection"]
    download(server.url, tmp_path / "f", QUICK)
    assert (tmp_path / "f").read_bytes() == CONTENT


def test_redirections_in_a_circle(serve: Callable, tmp_path: Path) -> None:
    server = serve(CONTENT)
    server.mood = ["endless redirection"] * 40
    with pytest.raises(SceneError, match="more than 10 redirections"):
        download(server.url, tmp_path / "f", Patience(connect=2, silence=0.3, attempts=1, pause=0.01))


def test_a_full_disk_is_said_before_the_transfer(
    serve: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=(1 << 28) + 1000))
    with pytest.raises(SceneError, match=r"1024000 bytes are to be written, and its disk has 268436456 free"):
        download(serve(CONTENT).url, tmp_path / "f", QUICK)


# ---- an archive of scenes


@pytest.fixture
def rooms(make_file: Callable[..., Path]) -> dict[str, bytes]:
    return {name: make_file(f"{name}.h5").read_bytes() for name in ("kitchen_02", "bathroom_02")}


def packed(files: dict[str, bytes], folder: str = "") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in files.items():
            file.writestr(f"{folder}{name}.h5", content)
    return buffer.getvalue()


def described(*mirrors: str, states: int = 5) -> Archive:
    scenes = {"kitchen_02": states, "bathroom_02": states}
    return Archive("thor-v1", "dumps.zip", mirrors, scenes, QUICK)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


@pytest.mark.parametrize("inside", ["", "data/thor/"])
def test_scenes_arrive_and_the_archive_goes(
    serve: Callable, tmp_path: Path, rooms: dict[str, bytes], inside: str
) -> None:
    server, said = serve(packed(rooms, inside)), []
    found = fetch(described(server.url), tmp_path / "out", say=said.append)
    assert [path.name for path in found] == ["kitchen_02.h5", "bathroom_02.h5"]
    assert {path.stem: path.read_bytes() for path in found} == rooms
    assert names(tmp_path / "out") == ["bathroom_02.h5", "kitchen_02.h5"]
    assert said == [f"fetching {server.url}", "unpacking and checking dumps.zip"]
    asked = len(server.asked)
    fetch(described(server.url), tmp_path / "out")
    assert len(server.asked) == asked  # nothing to do the second time


def test_what_a_mac_adds_to_an_archive_is_passed_over(
    serve: Callable, tmp_path: Path, rooms: dict[str, bytes]
) -> None:
    buffer = io.BytesIO(packed(rooms))
    with zipfile.ZipFile(buffer, "a") as file:
        file.writestr("__MACOSX/kitchen_02.h5", b"fork")
    found = fetch(described(serve(buffer.getvalue()).url), tmp_path / "out")
    assert found[0].read_bytes() == rooms["kitchen_02"]


@pytest.mark.parametrize("trouble", ["corrupt", "truncated archive", "404"])
def test_the_next_mirror_is_asked(
    serve: Callable, tmp_path: Path, rooms: dict[str, bytes], trouble: str
) -> None:
    content = packed(rooms)
    bad = serve(content[:-30] if trouble == "truncated archive" else content)
    bad.mood = [] if trouble == "truncated archive" else [trouble]
    good, said = serve(content), []
    fetch(described(bad.url, good.url), tmp_path / "out", say=said.append)
    assert names(tmp_path / "out") == ["bathroom_02.h5", "kitchen_02.h5"]
    assert (len(bad.asked), len(good.asked)) == (1, 1)
    assert any(line.startswith(("thrown away", "failed")) for line in said)


def huge(path: Path) -> None:
    """A dataset of 14.6 TiB in a file of a few kilobytes."""
    with h5py.File(path, "a") as file:
        del file["resnet_feature"]
        file.create_dataset("resnet_feature", (5, 800_000, 1_000_000), "f4", chunks=True)


@pytest.mark.parametrize("trouble", ["declares terabytes", "bomb", "wrong member"])
def test_an_archive_that_would_fill_the_machine_goes_and_the_next_mirror_is_asked(
    serve: Callable, tmp_path: Path, rooms: dict[str, bytes], trouble: str
) -> None:
    room = tmp_path / "changed.h5"
    room.write_bytes(rooms["bathroom_02"])
    if trouble == "declares terabytes":
        huge(room)
    changed = bytes(5 * (1 << 23) + 1) if trouble == "bomb" else room.read_bytes()
    content = packed({**rooms, "bathroom_02": changed})
    if trouble == "wrong member":  # a size in the archive's list that is not that of the member
        content = content.replace(struct.pack("<I", len(changed)), struct.pack("<I", len(changed) - 7))
    out, said = tmp_path / "out", []
    (good := serve(packed(rooms))).mood = []
    fetch(described(serve(content).url, good.url), out, say=said.append)
    assert names(out) == ["bathroom_02.h5", "kitchen_02.h5"]
    assert any(line.startswith("thrown away") for line in said)
    assert (out / "bathroom_02.h5").read_bytes() == rooms["bathroom_02"]


@pytest.mark.parametrize("trouble", ["count", "graph", "distance", "missing", "no zip"])
def test_what_does_not_pass_is_not_let_in(
    serve: Callable, tmp_path: Path, rooms: dict[str, bytes], trouble: str
) -> None:
    room = tmp_path / "changed.h5"
    room.write_bytes(rooms["bathroom_02"])
    with h5py.File(room, "a") as file:
        if trouble == "graph":
            file["graph"][2, 0] = 17
        elif trouble == "distance":
            file["shortest_path_distance"][0, 1] = 2
    files = {**rooms, "bathroom_02": room.read_bytes()}
    if trouble == "missing":
        del files["bathroom_02"]
    server = serve(b"<html>moved</html>" if trouble == "no zip" else packed(files))
    faults = {
        "count": r"kitchen_02.h5 has 5 states, but this scene has 6",
        "graph": r"bathroom_02.h5 dataset 'graph', state 2: action 0 leads to 17",
        "distance": r"state 0 to state 1: 2, but by the graph it is 1",
        "missing": r"has no bathroom_02.h5",
        "no zip": r"the file begins with b'<html>moved</htm', not with b'PK'",
    }
    out = tmp_path / "out"
    out.mkdir()
    (out / "kitchen_02.h5").write_bytes(b"older")
    with pytest.raises(SceneError, match=faults[trouble]):
        fetch(described(server.url, states=6 if trouble == "count" else 5), out)
    assert names(out) == ["kitchen_02.h5"]  # neither scenes nor archive nor parts
    assert (out / "kitchen_02.h5").read_bytes() == b"older"


def test_what_is_no_archive_goes_with_its_first_block(serve: Callable, tmp_path: Path) -> None:
    server = serve(b"")
    server.mood = ["endless"]
    with pytest.raises(SceneError, match=r"the file begins with b'x*', not with b'PK'"):
        fetch(described(server.url), tmp_path / "out")
    assert names(tmp_path / "out") == []


@pytest.mark.parametrize("url", ["http://a/\r\nX: y", "http://a/\x1b[2J", "http://a/" + "a" * 3000])
def test_mirrors_with_what_no_address_has(tmp_path: Path, url: str) -> None:
    with pytest.raises(
        ConfigError, match=r"thor-v1: mirror 'http://a/.*' is no address; correct it$"
    ) as caught:
        fetch(described(url), tmp_path / "out")
    assert caught.value.args[0].isprintable()
    assert not (tmp_path / "out").exists()


def test_an_archive_that_lies_here_is_used_and_replaced_when_it_is_bad(
    serve: Callable, tmp_path: Path, rooms: dict[str, bytes]
) -> None:
    server, out = serve(packed(rooms)), tmp_path / "out"
    out.mkdir()
    (out / "dumps.zip").write_bytes(packed(rooms))
    fetch(described(server.url), out)
    assert server.asked == []
    for path in out.iterdir():
        path.unlink()
    (out / "dumps.zip").write_bytes(b"half a zi")
    fetch(described(server.url), out)
    assert len(server.asked) == 1
    assert names(out) == ["bathroom_02.h5", "kitchen_02.h5"]


def test_every_mirror_is_named_when_none_helps(serve: Callable, tmp_path: Path) -> None:
    one, two = serve(b""), serve(b"")
    one.mood, two.mood = ["404"], ["503"] * 3
    with pytest.raises(SceneError) as caught:
        fetch(described("unused://"), tmp_path / "out", mirrors=[one.url, two.url])
    assert f"{one.url}: the server answers 404" in str(caught.value)
    assert f"{two.url}: nothing arrives" in str(caught.value)


# ---- the configuration


def test_the_archive_that_is_known() -> None:
    thor = archives()["thor-v1"]
    assert thor.mirrors == ("http://vision.stanford.edu/yukezhu/thor_v1_scene_dumps.zip",)
    assert list(thor.scenes.values()) == [180, 408, 676, 468]
    assert thor.patience == Patience(connect=15, silence=30, attempts=5, pause=1)


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("mine: {mirrors: ['http://a/b/c.zip'], scenes: {x: 3}, patience: {attempts: 9}}")
    mine = archives(path)["mine"]
    assert (mine.archive, mine.scenes, mine.patience.attempts) == ("c.zip", {"x": 3}, 9)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: {mirrors: [u], scenes: {x: 1}, mirors: 2}", "a: there is no key 'mirors'"),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: {tries: 2}}", "no key 'patience.tries'"),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: {attempts: 0}}", "patience.attempts is 0"),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: {attempts: 2.5}}", "patience.attempts is 2.5"),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: {silence: .nan}}", "patience.silence is nan"),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: {silence: .inf}}", "patience.silence is inf"),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: {pause: true}}", "patience.pause is True"),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: 5}", "patience is 5; map attempts, "),
        ("a: {mirrors: [u], scenes: {x: 1}, patience: [pause]}", r"patience is \['pause'\]; map"),
        ("a: {mirrors: [u], scenes: {x: 1}, 1: 2, zz: 3}", "a: there is no key 1; the keys are"),
        ("a: {mirrors: [u], scenes: {x: true}}", "a: scenes is {'x': True}; map each name"),
        ("a: {mirrors: [u], scenes: {x: 0}}", "a: scenes is {'x': 0}; map each name"),
        ("a: {mirrors: [u], scenes: {}}", "a: scenes is {}; map each name"),
        ("a: {mirrors: [u], scenes: {../evil: 3}}", "a: scenes names '../evil', which is no name of a file"),
        (
            "a: {mirrors: [u], scenes: {x: 3}, archive: ../../x.zip}",
            "a: archive names '../../x.zip', which is no",
        ),
        ("a: {mirrors: [u], scenes: {x: 3}, archive: /tmp/x.zip}", "archive names '/tmp/x.zip'"),
        ("a: {mirrors: [u], scenes: {x: 3}, archive: ..}", "archive names '..'"),
        ("a: {mirrors: ['http://a/..'], scenes: {x: 3}}", "archive names '..'"),
        ("a: {mirrors: [], scenes: {x: 1}}", r"mirrors is \[\]"),
        ("a: {mirrors: [u], scenes: [x]}", r"scenes is \['x'\]"),
        ("just words", "must map names"),
        ("a: {", "cannot be read as YAML"),
    ],
)
def test_a_wrong_file_is_told(tmp_path: Path, text: str, fault: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=fault):
        archives(path)
