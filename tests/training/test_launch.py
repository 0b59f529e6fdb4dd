"""From the command line to settings: what is saved, what is checked, what is said of mistakes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.errors import CheckpointError, ConfigError
from vusfa.training import save_checkpoint
from vusfa.training.launch import compose, launch, with_saved_overrides


@pytest.fixture
def conf(tmp_path: Path) -> Path:
    folder = tmp_path / "conf"
    (folder / "optim").mkdir(parents=True)
    (folder / "optim" / "adam.yaml").write_text("lr: 0.1\nsteps: 5\n")
    (folder / "optim" / "sgd.yaml").write_text("lr: 1\nsteps: 5\n")
    (folder / "main.yaml").write_text(
        "defaults: [{optim: adam}, _self_, {override hydra/job_logging: none},"
        " {override hydra/hydra_logging: none}]\n"
        "seed: 0\nhalf: ${seed}\nverbose: false\nresume: null\n"
        "hydra:\n  output_subdir: null\n  run: {dir: .}\n"
    )
    return folder


@pytest.fixture
def run(conf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs a job from a command line, in an empty folder; gives exit code and standard error."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")

    def launched(*arguments: str, job=None) -> tuple[int, str]:
        monkeypatch.setattr("sys.argv", ["recipe.py", *arguments])
        with pytest.raises(SystemExit) as end:
            launch(job or (lambda cfg, overrides: 0), conf, "main")
        assert list(Path.cwd().iterdir()) == []
        return end.value.code, capsys.readouterr().err

    return launched


def test_the_job_gets_settings_and_the_command_line(run):
    seen = {}

    def job(cfg, overrides):
        seen.update(OmegaConf.to_container(cfg), overrides=overrides)
        return 7

    assert run("optim=sgd", "seed=3", job=job) == (7, "")
    assert seen["optim"] == {"lr": 1, "steps": 5}
    assert (seen["seed"], seen["half"]) == (3, 3)
    assert seen["overrides"] == ["--config-name=main", "optim=sgd", "seed=3"]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("sed=3", "no setting is called 'sed'; did you mean 'seed'?"),
        ("optim.lrr=3", "no setting is called 'optim.lrr'; did you mean 'optim.lr'?"),
        ("optin=sgd", "no setting is called 'optin'; did you mean 'optim'?"),
        ("optim=adamm", "optim=adamm: there is no such choice; did you mean 'adam'?"),
        ("optim=xyz", "optim=xyz: there is no such choice; there are adam, sgd"),
        ("seed", "cannot read 'seed'"),
        ("seed=[1", "cannot read 'seed=[1'"),
        ("seed=abc", "seed is 'abc'; it must be a whole number, such as 0"),
        ("seed=1.5", "seed is 1.5; it must be a whole number, such as 0"),
        ("optim.lr=fast", "optim.lr is 'fast'; it must be a number, such as 0.1"),
        ("optim.lr=true", "optim.lr is True; it must be a number, such as 0.1"),
        ("verbose=1", "verbose is 1; it must be true or false"),
        ("+sede=3", "no setting is called 'sede'; did you mean 'seed'?"),
        ("++optim.lrr=3", "no setting is called 'optim.lrr'; did you mean 'optim.lr'?"),
        ("~optim.lr", "optim.lr is missing; it may be 0.1"),
        ("optim=null", "a group of settings cannot be null"),
        ("half=${sed}", "Interpolation key 'sed' not found"),
    ],
)
def test_a_mistake_is_one_line(run, argument: str, message: str):
    code, text = run(argument)
    assert code == 2
    assert text.startswith(f"error: {message}")
    assert text.count("\n") == 1


def test_our_errors_are_one_line_and_bugs_are_not(run, capsys: pytest.CaptureFixture[str]):
    def refuse(cfg, overrides):
        raise ConfigError("the agent has two heads; give it one")

    assert run(job=refuse) == (2, "error: the agent has two heads; give it one\n")

    def bug(cfg, overrides):
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError):
        run(job=bug)
    capsys.readouterr()

    def interrupted(cfg, overrides):
        raise KeyboardInterrupt

    code, text = run(job=interrupted)
    assert code == 130
    assert text.startswith("error: interrupted")


def test_every_run_of_a_sweep_has_its_folder(run, conf: Path):
    (conf / "main.yaml").write_text(
        (conf / "main.yaml").read_text().replace("seed: 0\n", "seed: 0\nfolder: here\n")
        + "  sweep: {dir: ../sweep, subdir: '${hydra.job.num}'}\n"
    )
    folders = []

    def job(cfg, overrides):
        folders.append(Path(cfg.folder).name)
        return len(folders)

    assert run("--multirun", "seed=1,2", job=job)[0] == 2
    assert run("--multirun", "seed=1,2", "folder=mine", job=job)[0] == 4
    assert folders == ["0", "1", "mine", "mine"]


def test_compose_is_what_the_command_line_would_be(conf: Path):
    assert compose(conf, "main", ["optim=sgd", "optim.lr=4"]).optim == {"lr": 4, "steps": 5}


def test_a_resumed_run_keeps_its_settings(tmp_path: Path):
    path = tmp_path / "my run" / "checkpoint.pt"
    state = {"agent_config": {}, "agent": {}, "scenes": {}, "goals": torch.tensor([1]), "frames": 5}
    saved = ["optim=sgd", "seed=3", "+extra=1", "folder=elsewhere", f"resume={tmp_path / 'older.pt'}"]
    save_checkpoint(path, {**state, "overrides": saved})
    assert with_saved_overrides([f"resume={path}", "seed=4"]) == [
        "optim=sgd",
        "+extra=1",
        f"folder='{tmp_path / 'my run'}'",
        f"resume={path}",
        "seed=4",
    ]
    assert with_saved_overrides([f"resume={path}", "folder=there", "extra=2"]) == [
        "optim=sgd",
        "seed=3",
        f"folder='{tmp_path / 'my run'}'",
        f"resume={path}",
        "folder=there",
        "extra=2",
    ]
    assert with_saved_overrides(["resume=null"]) == ["resume=null"]
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        with_saved_overrides(["resume=none.pt"])
