"""push_to_hub and from_pretrained against a stand-in for a model hub on 127.0.0.1."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module, reload
from pathlib import Path
from typing import Any

import pytest
import torch
from huggingface_hub import constants

from vusfa.deploy import open_agent
from vusfa.deploy.hub import HubAgent
from vusfa.errors import CheckpointError, ConfigError, SceneError

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class Hub(ThreadingHTTPServer):
    """Keeps the files of commits, by repository and path."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[tuple[str, str], bytes] = {}
        self.asked: list[str] = []
        self.ended = threading.Event()


class Handler(BaseHTTPRequestHandler):
    server: Hub

    def log_message(self, *_: Any) -> None:
        pass

    def answer(self, content: Any, status: int = 200, **headers: str) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self) -> None:
        self.server.asked.append(self.path)
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.path == "/api/repos/create":
            self.answer({"url": f"http://{self.headers['Host']}/someone/{json.loads(body)['name']}"})
        elif self.path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif "/preupload/" in self.path:
            files = json.loads(body)["files"]
            self.answer(
                {
                    "files": [
                        {"path": f["path"], "uploadMode": "regular", "shouldIgnore": False} for f in files
                    ]
                }
            )
        elif found := re.fullmatch(r"/api/models/([^/]+/[^/]+)/commit/main", self.path):
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    value = line["value"]
                    self.server.files[found[1], value["path"]] = base64.b64decode(value["content"])
            self.answer({"success": True, "commitOid": COMMIT, "commitUrl": f"/{found[1]}/commit/{COMMIT}"})
        else:
            self.answer({"error": "unknown"}, 404)

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        found = re.fullmatch(r"/([^/]+/[^/]+)/resolve/[^/]+/(.+)", self.path)
        content = self.server.files.get((found[1], found[2])) if found else None
        if content is not None:
            etag = f'"{hashlib.sha1(content).hexdigest()}"'
            self.answer(content, ETag=etag, X_Repo_Commit=COMMIT)
        elif found and any(name == found[1] for name, _ in self.server.files):
            self.answer({}, 404, X_Error_Code="EntryNotFound", X_Repo_Commit=COMMIT)
        elif re.fullmatch(r"/api/models/[^/]+/[^/]+(/revision/main)?", self.path):
            name = "/".join(self.path.split("/")[3:5])
            self.answer({"id": name, "sha": COMMIT, "siblings": []})
        else:
            self.answer({}, 404, X_Error_Code="RepoNotFound")

    do_HEAD = do_GET


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    server = Hub()
    address = f"http://127.0.0.1:{server.server_port}"
    monkeypatch.setattr(constants, "ENDPOINT", address)
    monkeypatch.setattr(
        constants, "HUGGINGFACE_CO_URL_TEMPLATE", address + "/{repo_id}/resolve/{revision}/{filename}"
    )
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_PROGRESS_BARS", True)
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server
    server.ended.set()
    server.shutdown()
    server.server_close()


@pytest.fixture
def trained(world: Any) -> HubAgent:
    return HubAgent(
        open_agent(world.checkpoint("sfdp"), world.scenes)._replace(card="---\nlicense: mit\n---\n# One")
    )


def test_an_agent_goes_to_the_hub_and_comes_back(hub: Hub, trained: HubAgent) -> None:
    trained.push_to_hub("someone/walker", token="hf_stand_in")
    assert {path for _, path in hub.files} >= {"agent.safetensors", "README.md"}
    assert hub.files["someone/walker", "README.md"].decode() == trained.trained.card
    with pytest.raises(SceneError, match="a hub has no rooms: give them as scenes="):
        HubAgent.from_pretrained("someone/walker")
    found = HubAgent.from_pretrained("someone/walker", scenes=trained.trained.scenes).trained
    assert found.card == trained.trained.card
    assert torch.equal(found.goals, trained.trained.goals)
    assert found.scenes.fingerprint == trained.trained.scenes.fingerprint
    for name, value in trained.trained.agent.state_dict().items():
        assert torch.allclose(found.agent.state_dict()[name], value, atol=0.03 * value.abs().max().item())


def test_nothing_is_asked_for_unasked(hub: Hub, trained: HubAgent, tmp_path: Path) -> None:
    trained.save_pretrained(tmp_path / "walker")
    assert {path.name for path in (tmp_path / "walker").iterdir()} == {"agent.safetensors", "README.md"}
    assert HubAgent.from_pretrained(tmp_path / "walker").trained.agent.config["model"] == "sfdp"
    open_agent(tmp_path / "walker" / "agent.safetensors")
    assert hub.asked == []


def test_what_is_not_there_or_is_no_agent_is_one_error(hub: Hub, tmp_path: Path) -> None:
    hub.files["someone/else", "model.bin"] = b"1"
    with pytest.raises(CheckpointError, match=r"someone/else: has no agent\.safetensors"):
        HubAgent.from_pretrained("someone/else")
    with pytest.raises(CheckpointError, match=r"someone/nobody: cannot be fetched"):
        HubAgent.from_pretrained("someone/nobody")
    hub.files["someone/else", "agent.safetensors"] = b"nothing"
    hub.files["someone/else", "README.md"] = b"# None"
    with pytest.raises(CheckpointError, match="no agent of vusfa"):
        HubAgent.from_pretrained("someone/else")


ANSWERS = {
    "circle": (302, {"Location": "/someone/liar/resolve/main/agent.safetensors"}),
    "to a file": (302, {"Location": "file:///etc/passwd"}),
    "commit that climbs": (200, {"ETag": '"a"', "X_Repo_Commit": "../../../../evil"}),
    "terabytes": (200, {"ETag": '"a"', "X_Repo_Commit": COMMIT, "Content_Length": str(10**13)}),
    "refusal": (403, {}),
}


@pytest.mark.parametrize("lie", ANSWERS)
def test_whatever_a_hub_answers_is_one_line(hub: Hub, monkeypatch: pytest.MonkeyPatch, lie: str) -> None:
    def answer(handler: Handler) -> None:
        status, headers = ANSWERS[lie]
        handler.send_response(status)
        for name, value in {"Content_Length": "0", **headers}.items():
            handler.send_header(name.replace("_", "-"), value)
        handler.end_headers()

    monkeypatch.setattr(Handler, "do_GET", answer)
    monkeypatch.setattr(Handler, "do_HEAD", answer)
    with pytest.raises(CheckpointError, match=r"^someone/liar: cannot be fetched \(") as caught:
        HubAgent.from_pretrained("someone/liar")
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("drips", [True, False])
def test_a_hub_that_drips_or_says_nothing_is_given_up(
    hub: Hub, monkeypatch: pytest.MonkeyPatch, drips: bool
) -> None:
    def answer(handler: Handler) -> None:
        if handler.command == "HEAD":
            return handler.answer(b"x" * 1000, ETag='"a"', X_Repo_Commit=COMMIT)
        handler.send_response(200)
        handler.send_header("Content-Length", "1000")
        handler.end_headers()
        with suppress(OSError):
            while not hub.ended.wait(0.02):
                handler.wfile.write(b"x" if drips else b"")

    monkeypatch.setattr(Handler, "do_GET", answer)
    monkeypatch.setattr(Handler, "do_HEAD", answer)
    words = r"^someone/slow: agent\.safetensors has not arrived within 0\.5 s; check the connection"
    with pytest.raises(CheckpointError, match=words):
        HubAgent.from_pretrained("someone/slow", patience=0.5)


@pytest.mark.parametrize("name", ["a/b/c", "../x", "", "-x", "x" * 5000])
def test_names_that_no_repository_has(hub: Hub, name: str) -> None:
    with pytest.raises(CheckpointError, match=r"cannot be fetched|no such file"):
        HubAgent.from_pretrained(name)
    assert hub.asked == []


def test_without_a_connection_it_is_not_called_no_agent(hub: Hub) -> None:
    with pytest.raises(CheckpointError, match=r"cannot be fetched \(agent\.safetensors: "):
        HubAgent.from_pretrained("someone/walker", local_files_only=True)


@pytest.mark.parametrize("content", [b"{", b"[1]", b"[" * 100_000, b'{"a": "\xe9"}'])
def test_a_config_that_agents_do_not_have_is_not_read(
    hub: Hub, trained: HubAgent, tmp_path: Path, content: bytes
) -> None:
    trained.save_pretrained(tmp_path)
    (tmp_path / "config.json").write_bytes(content)
    scenes = trained.trained.scenes
    assert HubAgent.from_pretrained(tmp_path, scenes=scenes).trained.agent.config["model"] == "sfdp"
    for path in tmp_path.iterdir():
        hub.files["someone/walker", path.name] = path.read_bytes()
    HubAgent.from_pretrained("someone/walker", scenes=scenes)
    assert not any("config.json" in path for path in hub.asked)


def test_model_cards_that_are_missing_or_no_text(hub: Hub, trained: HubAgent, tmp_path: Path) -> None:
    trained.save_pretrained(tmp_path)
    scenes, card = trained.trained.scenes, tmp_path / "README.md"
    hub.files["someone/walker", "agent.safetensors"] = (tmp_path / "agent.safetensors").read_bytes()
    assert HubAgent.from_pretrained("someone/walker", scenes=scenes).trained.card == ""
    for content, fault in [(b"caf\xe9", "utf-8"), (b"x" * (1 << 21), "more than 1048576 bytes")]:
        card.write_bytes(content)
        with pytest.raises(CheckpointError, match=rf"README\.md: cannot be read \(.*{fault}"):
            HubAgent.from_pretrained(tmp_path, scenes=scenes)


def test_an_agent_of_the_bundled_rooms_names_them_and_no_path(tmp_path: Path) -> None:
    HubAgent.open("gvf").save_pretrained(tmp_path)
    text = (tmp_path / "agent.safetensors").read_bytes()[:4000].decode("latin1")
    assert '\\"sources\\": [\\"bathroom\\", \\"bedroom\\", \\"kitchen\\", \\"living_room\\"]' in text
    assert (tmp_path / "README.md").read_text("utf-8").startswith("---\nlicense: mit")


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    module = import_module("vusfa.deploy.hub")
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "huggingface_hub", None)
        with pytest.raises(ConfigError, match=r"pip install 'vusfa\[hub\]'"):
            reload(module)
    reload(module)
