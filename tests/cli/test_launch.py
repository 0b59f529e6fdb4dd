"""From the command line to settings: what is checked, what is said of mistakes, what a resumed run takes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from typer.testing import CliRunner

from vusfa.cli.app import app
from vusfa.cli.launch import compose, launch
from vusfa.errors import ConfigError, ResultError
from vusfa.training import save_checkpoint


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs a job from a command line, in an empty folder; gives exit code and standard error."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")

    def launched(*arguments: str, job=None) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["recipe.py", *arguments])
        with pytest.raises(SystemExit) as end:
            launch(job or (lambda settings, overrides: 0))
        assert list(Path.cwd().iterdir()) == []
        return end.value.code, capsys.readouterr().err

    return launched


@pytest.fixture
def settings_of(run):
    """Settings that a job gets from a command line."""

    def settings(*arguments: str) -> dict[str, Any]:
        seen: dict[str, Any] = {}
        assert run(*arguments, job=lambda given, overrides: seen.update(given) or 0) == (0, "")
        return seen

    return settings


def test_the_job_gets_settings_and_the_command_line(run):
    seen = {}

    def job(settings, overrides):
        seen.update(settings, overrides=overrides)
        return 7

    assert run("optim=rmsprop", "seed=3", "total_frames=5", "optim.horizon=${total_frames}", job=job) == (
        7,
        "",
    )
    assert seen["optim"]["kind"] == "rmsprop"
    assert (seen["seed"], seen["optim"]["horizon"]) == (3, 5)
    assert seen["overrides"][:2] == ["optim=rmsprop", "seed=3"]
    assert type(seen["optim"]) is dict


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("sed=3", "no setting is called 'sed'; did you mean 'seed'?"),
        ("optim.lrr=3", "no setting is called 'optim.lrr'; did you mean 'optim.lr'?"),
        ("optin=sgd", "no setting is called 'optin'; did you mean 'optim'?"),
        ("optim=adamm", "optim=adamm: there is no such choice; did you mean 'adam'?"),
        ("optim=xyz", "optim=xyz: there is no such choice; there are a3c, adam, adam_large_batch, rmsprop"),
        ("seed", "cannot read 'seed'"),
        ("seed=[1", "cannot read 'seed=[1'"),
        ("seed=abc", "seed is 'abc'; it must be a whole number, such as 0"),
        ("seed=-1", "seed is -1; it must be 0 to 4294967295"),
        ("seed=4294967296", "seed is 4294967296; it must be 0 to 4294967295"),
        ("total_frames=1e3", "total_frames is 1000.0; it must be a whole number, such as 1000"),
        ("preset=paper total_frames=1e3", "total_frames is 1000.0; it must be a whole number, such as 1000"),
        ("collector.timeout=0", "collector.timeout is 0.0; it must be more than 0"),
        ("overwrite=yes", "overwrite is 'yes'; it must be true or false"),
        ("seed=1.5", "seed is 1.5; it must be a whole number, such as 0"),
        ("seed=null", "seed is null; it must be a whole number, such as 0"),
        ("optim.lr=fast", "optim.lr is 'fast'; it must be a number, such as 0.001"),
        ("optim.lr=true", "optim.lr is True; it must be a number, such as 0.001"),
        ("objective.normalize_advantage=1", "objective.normalize_advantage is 1; it must be true or false"),
        ("+sede=3", "no setting is called 'sede'; did you mean 'seed'?"),
        ("++optim.lrr=3", "no setting is called 'optim.lrr'; did you mean 'optim.lr'?"),
        ("~optim.lr", "optim.lr is missing; it may be 0.001"),
        ("optim=null", "a group of settings cannot be null"),
        ("entropy=null", "entropy is null; it is a group of settings: give entropy.start=..."),
        ("optim.horizon=${sed}", "Interpolation key 'sed' not found"),
        ("folder=${oc.env:NOBODY}", "KeyError raised while resolving interpolation"),
    ],
)
def test_a_mistake_is_one_line(run, argument: str, message: str):
    code, text = run(*argument.split())
    assert code == 2
    assert text.startswith(f"error: {message}")
    assert text.count("\n") == 1


def test_our_errors_are_one_line_and_bugs_are_not(run, capsys: pytest.CaptureFixture[str]):
    def refuse(settings, overrides):
        raise ConfigError("the agent has two heads; give it one")

    assert run(job=refuse) == (2, "error: the agent has two heads; give it one\n")

    def bug(settings, overrides):
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError):
        run(job=bug)
    capsys.readouterr()

    def interrupted(settings, overrides):
        raise KeyboardInterrupt

    code, text = run(job=interrupted)
    assert code == 130
    assert text.startswith("error: interrupted")


def test_every_run_of_a_sweep_has_its_folder(run):
    folders = []

    def job(settings, overrides):
        folders.append(Path(settings["folder"]))
        return len(folders)

    sweep = "hydra.sweep.dir=../sweep"
    assert run("--multirun", sweep, "seed=1,2", job=job)[0] == 2
    assert run("--multirun", sweep, "seed=1,2", "folder=mine", job=job)[0] == 4
    assert [str(folder) for folder in folders[2:]] == ["mine/0", "mine/1"]
    assert [folder.name for folder in folders[:2]] == ["0", "1"]
    assert run("--multirun", sweep, "seed=1", "folder=one,two", job=job)[0] == 6
    assert run("--multirun", sweep, "seed=1,2", "folder=run${seed}", job=job)[0] == 8
    assert [str(folder) for folder in folders[4:]] == ["one", "two", "run1", "run2"]


@pytest.mark.parametrize("code", [129, 130, 143])
def test_a_signal_ends_a_sweep(run, code: int):
    """SIGHUP, Ctrl-C, SIGTERM: the job says that it was ended by one, and no other job begins."""
    jobs = []
    assert (
        run("--multirun", "hydra.sweep.dir=../sweep", "seed=1,2,3", job=lambda *_: jobs.append(1) or code)[0]
        == code
    )
    assert len(jobs) == 1


def test_a_run_that_fails_does_not_end_a_sweep(run):
    jobs = []

    def job(settings, overrides):
        jobs.append(settings["seed"])
        if settings["seed"] == 1:
            raise ResultError("a.csv: cannot be written (No space left on device)")
        return 0

    code, text = run("--multirun", "hydra.sweep.dir=../sweep", "seed=1,2", job=job)
    assert (code, jobs) == (1, [1, 2])
    assert text == "error: a.csv: cannot be written (No space left on device)\n"


def test_faults_of_the_system_are_one_line(run):
    def full(settings, overrides):
        raise OSError(28, "No space left on device", "a.csv")

    code, text = run(job=full)
    assert (code, text.count("\n")) == (1, 1)
    assert text.startswith("error: a.csv: No space left on device; ")


def test_resume_auto(run, checkpoint, settings_of):
    path = checkpoint("seed=3")
    settings = settings_of("resume=auto", f"folder='{path.parent}'", "preset=controlled", "seed=4")
    assert (settings["resume"], settings["seed"], settings["name"]) == (str(path), 4, "controlled")
    assert settings_of("resume=auto", "folder=nothing")["resume"] is None
    assert run("resume=auto")[1].startswith("error: resume=auto looks into the run's folder; give folder=")


@pytest.mark.parametrize(
    "name",
    ["lr=1,2 (b)", "it's", "[a]{b}:c", "a\\'b", "naïve-日本 😀", "a;b&c", "~a*b#c", 'say"hi"', "a,b"],
)
def test_a_run_in_any_folder_can_be_resumed(checkpoint, settings_of, name: str):
    path = checkpoint("seed=3")
    odd = path.parent.with_name(name)
    path.parent.rename(odd)
    settings = settings_of(f"resume={odd / 'checkpoint.pt'}")
    assert (settings["folder"], settings["seed"]) == (str(odd), 3)
    assert settings_of(f"folder={odd}")["folder"] == str(odd)


@pytest.mark.parametrize("line", ["scenes=küche.h5", "scenes=[bathroom,räume/a.h5]", "logger.name=prüfung"])
def test_names_that_are_not_ascii_are_read(settings_of, line: str):
    name, _, value = line.partition("=")
    found = settings_of(line)
    assert (found["logger"]["name"] if "." in name else found[name]) in (value, value.strip("[]").split(","))


def test_a_sweep_may_be_asked_for_anywhere_on_the_command_line(run):
    seeds = []
    words = ["optim=adam", "--multirun", "hydra.sweep.dir=../sweep", "seed=1,2"]
    assert run(*words, job=lambda settings, _: seeds.append(settings["seed"]) or 0) == (0, "")
    assert seeds == [1, 2]


def test_compose_is_what_the_command_line_would_be():
    assert compose(overrides=["optim=rmsprop", "optim.lr=4"]).optim.lr == 4.0


@pytest.fixture
def checkpoint(tmp_path: Path, settings_of, checkpoint_state: dict[str, Any]):
    """A checkpoint with the settings of a command line, and what is put over them."""

    def make(*arguments: str, **more: Any) -> Path:
        config = settings_of(*arguments)
        for name, value in more.pop("config", {}).items():
            OmegaConf.update(config := OmegaConf.create(config), name, value)
            config = OmegaConf.to_container(config)
        state = {**checkpoint_state, "config": config, "overrides": list(arguments)}
        return save_checkpoint(tmp_path / "my run" / "checkpoint.pt", {**state, **more})

    return make


def test_a_resumed_run_keeps_its_settings(checkpoint, settings_of):
    path = checkpoint("optim=rmsprop", "seed=3", "folder=elsewhere", "preset=controlled")
    settings = settings_of(f"resume={path}", "entropy.start=0.5")
    assert (settings["optim"]["kind"], settings["seed"], settings["entropy"]["start"]) == ("rmsprop", 3, 0.5)
    assert (settings["folder"], settings["resume"]) == (str(path.parent), str(path))
    assert settings["scenes"] == ["kitchen"]
    settings = settings_of(f"resume={path}", "folder=there", "optim=adam", "scenes=[bathroom]", "seed=4")
    assert (settings["folder"], settings["optim"]["kind"], settings["seed"]) == ("there", "adam", 4)
    assert settings["scenes"] == ["bathroom"]
    assert settings["agent"] == settings_of("preset=controlled")["agent"]


def test_schedules_end_with_the_resumed_run(checkpoint, settings_of):
    path = checkpoint("total_frames=700", "entropy.horizon=600")
    settings = settings_of(f"resume={path}", "total_frames=900")
    assert (settings["optim"]["horizon"], settings["entropy"]["horizon"]) == (900, 600)
    assert settings_of(f"resume={path}", "optim=adam")["optim"]["horizon"] == 700
    settings = settings_of(f"resume={path}", "total_frames=900", "optim.horizon=700")
    assert settings["optim"]["horizon"] == 700


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"config": {"optim.lr": "fast"}}, "optim.lr is 'fast'; it must be a number"),
        ({"config": {"hydra": {"x": 1}}}, "no setting is called 'hydra.x'"),
        (
            {"config": {"optim.options": {"_target_": "os.system"}}},
            "is called 'optim.options._target_'",
        ),
        ({"config": {"folder": "${oc.env:HOME}"}}, "folder is '${oc.env:HOME}'; it must not refer"),
        ({"config": {"algorithm": {"name": "mine"}}}, "no such algorithm is registered"),
        ({"config": {"log_every": 0}}, "log_every is 0; it must be more than 0"),
    ],
    ids=["type", "hydra", "target", "interpolation", "algorithm", "range"],
)
def test_settings_of_a_checkpoint_are_checked(run, checkpoint, more: dict[str, Any], words: str):
    config = more["config"]
    if "folder" in config:  # update() would look it up
        plain = checkpoint()
        state = torch.load(plain, weights_only=True)
        state["config"] |= config
        path = save_checkpoint(plain, state)
    else:
        path = checkpoint(**more)
    code, text = run(f"resume={path}")
    assert code == 2
    assert text.startswith(f"error: {path}: ")
    assert words in text
    assert text.count("\n") == 1


def test_the_recorded_command_line_of_a_checkpoint_is_never_run(run, checkpoint, tmp_path: Path):
    trap = tmp_path / "sprung"
    target = f"{{_target_: pathlib.Path.touch, self: {trap}}}"
    code, text = run(f"resume={checkpoint(overrides=[f'+hydra.callbacks.x={target}'])}")
    assert (code, text.count("\n"), trap.exists()) == (2, 1, False)
    assert "checkpoint.pt: its command line holds '+hydra.callbacks.x=" in text
    seen: dict[str, Any] = {}
    path = checkpoint(overrides=["--config-dir=/tmp", "seed=77"])
    assert run(f"resume={path}", job=lambda settings, overrides: seen.update(settings) or 0) == (0, "")
    assert seen["seed"] == 0


@pytest.mark.parametrize("argument", ["preset=paper", "~optim.lr"])
def test_what_cannot_be_given_beside_resume(run, checkpoint, argument: str):
    code, text = run(f"resume={checkpoint()}", argument)
    assert (code, text.count("\n")) == (2, 1)


def test_settings_without_a_checkpoint_file(run):
    assert run("resume=none.pt") == (
        2,
        "error: none.pt: no such checkpoint; vusfa train writes RUN/checkpoint.pt\n",
    )


def test_a_name_that_the_locale_cannot_read_is_one_line(run):
    code, text = run("folder=caf\udce9")
    assert (code, text.count("\n")) == (2, 1)
    assert "caf\\udce9'\" is no text in this locale; set PYTHONUTF8=1, or rename it" in text


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: 40 bytes")],
)
def test_memory_that_is_not_there_is_one_line(run, error: Exception, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: Any) -> int:
        raise error

    code, text = run(job=fail)
    assert (code, text.count("\n")) == (1, 1)
    assert text.startswith("error: out of memory; give fewer collector.num_envs")
    monkeypatch.setattr("vusfa.scenes.validate", fail)
    done = CliRunner().invoke(app, ["scenes", "check", "bathroom"])
    assert (done.exit_code, done.stderr) == (
        1,
        "error: out of memory; close other programs, or allow more (ulimit)\n",
    )
