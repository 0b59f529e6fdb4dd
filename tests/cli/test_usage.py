"""Wrong command lines, targets that cannot be written, numbers without bound, unknown names: one line each,
before any work."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from vusfa.cli.app import app
from vusfa.scenes.store import bundled_path


def said(*words: object) -> tuple[int, str]:
    """Exit code and the only line on standard error, which names no traceback."""
    done = CliRunner().invoke(app, [str(word) for word in words], prog_name="vusfa")
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    return done.exit_code, done.stderr[len("error: ") : -1]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("evaluate run episodes=nope", "episodes is 'nope'; it should be a valid integer"),
        (
            "evaluate run unreachable=x",
            "unreachable is 'x'; 'x' is not one of 'skip', 'fail'; vusfa evaluate",
        ),
        ("evaluate run --nope", "no such option: --nope"),
        ("evaluate", "missing argument 'checkpoint'; vusfa evaluate --help lists what there is"),
        ("film", "missing argument 'CHECKPOINT'; vusfa film --help"),
        ("run vusfa", "missing option '--goal'"),
        ("film vusfa --goal", "option '--goal' requires an argument"),
        ("film vusfa greedy=perhaps", "got unexpected extra argument"),
        ("table1 seeds=[1,x]", "seeds is 'x'; it should be a valid integer"),
        ("transfer nope", "no such command 'nope'"),
        ("evaluat", "no such command 'evaluat'. Did you mean 'evaluate'?"),
        ("scenes nope", "no such command 'nope'; vusfa scenes --help"),
        ("scenes show bathroom pictures=0", "pictures is '0'; it should be greater than or equal to 1"),
        (f"scenes show bathroom pictures={'9' * 5000}", "pictures is '999"),
        ("scenes from-photos x store=tiff", "store is 'tiff'; 'tiff' is not one of 'jpeg', 'raw'"),
        ("pretrained show", "missing argument 'name'"),
        ("report x mode=\x1b[2J", r"mode is '\x1b[2J'"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_exit_code_2(line: str, words: str) -> None:
    code, text = said(*line.split(" "))
    assert code == 2
    assert text.startswith(words)
    assert len(text) < 500


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("evaluate run max_steps=1000000000", "max_steps is 1000000000; give 1 to 100,000"),
        ("evaluate run episodes=1000000000", "episodes is 1000000000; give 1 to 1,000,000"),
        ("evaluate run seed=1" + 30 * "0", "seed is 1" + 30 * "0" + "; give 0 to 9,223,372,036,854,775,807"),
        ("film vusfa attempts=1000000", "attempts is 1000000; give 1 to 10,000"),
        ("film vusfa goal=1" + 30 * "0", "goal is 1" + 30 * "0" + "; give a number that a computer"),
        ("report x walks=1000000", "walks is 1000000; give 0 to 10,000"),
        ("report x megabytes=nan", "megabytes is nan; give 0 to 4,096"),
        ("tables resamples=100000000", "resamples is 100000000; give 1 to 100,000"),
        ("table1 seeds=[0,99999999999]", "seeds is 99999999999; give 0 to 4,294,967,295"),
        ("generalise rooms weight=inf", "weight is inf; give a number"),
        ("scenes render kind=bathroom width=1000000", "width is 1000000; give 1 to 4,096"),
        ("scenes render kind=bathroom samples=1000000", "samples is 1000000; give 1 to 4,096"),
        ("scenes augment bathroom out=x.h5 pictures=1000000", "pictures is 1000000; give 1 to 10,000"),
        ("scenes list walk_steps=1000000000", "walk_steps is 1000000000; give 0 to 100,000"),
    ],
)
def test_numbers_without_bound_name_their_limit(line: str, words: str) -> None:
    assert said(*line.split()) == (1, words) or said(*line.split())[1].startswith(words)


@pytest.mark.parametrize(
    ("line", "shown"),
    [
        ("film vusfa out=/proc/x.gif", "the file to write is '/proc/x.gif'"),
        ("scenes show bathroom out=/proc/x.png", "the file to write is '/proc/x.png'"),
        ("scenes compact bathroom /proc/x.h5", "the file to write is '/proc/x.h5'"),
        ("scenes fetch thor-v1 out=/proc/x", "the folder of the scenes is '/proc/x'"),
        ("scenes render-rooms /proc/x plan=bathroom", "the folder of the rooms is '/proc/x'"),
        ("export vusfa /proc/x.onnx", "the file to write is '/proc/x.onnx'"),
        ("report vusfa out=/proc/x.html", "out is '/proc/x.html'"),
        ("tables table1 plot=/proc/x.png", "plot is '/proc/x.png'"),
        ("tables table1 out=/proc/x", "out is '/proc/x'"),
        ("tables table1 docs=/proc/x", "docs is '/proc/x'"),
        ("transfer show out=/proc/x.png", "the file to write is '/proc/x.png'"),
        ("robustness run changes results=/proc/x", "results is '/proc/x/robustness'"),
        ("table1 results=/proc/x", "the folder of results is '/proc/x/table1'"),
        ("table1 runs=/proc/x", "runs is '/proc/x/table1'"),
        (
            "generalise ROOMS trained=1 tested=1 results=/proc/x",
            "the folder of results is '/proc/x/generalise'",
        ),
        ("generalise ROOMS trained=1 tested=1 runs=/proc/x", "runs is '/proc/x/generalise'"),
    ],
)
def test_a_target_that_cannot_be_written_is_found_before_the_work(
    line: str, shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for number in range(2):
        (tmp_path / f"room-{number}.h5").symlink_to(bundled_path("bathroom"))
    code, text = said(*line.replace("ROOMS", str(tmp_path)).split())
    assert (code, text.count("but /proc may not be written (")) == (1, 1), text
    assert text.startswith(shown)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("transfer run models=[nope]", "models has 'nope'; there are gvf, usfa, sfdp, vusfa"),
        ("transfer run kinds=[1-stp]", "kinds has '1-stp'; did you mean '1-step'?"),
        ("transfer run source=nope", "results/nope: no results of gvf-0; there are none"),
        ("transfer run every=0", "every is 0; it must be at least 1"),
        ("transfer run experiment=a/b", "a run cannot be called 'a/b'"),
        (
            "transfer show experiment=nope",
            "results: no results of nope; there are none; run vusfa transfer run",
        ),
        ("table1 models=[vufsa]", "models has 'vufsa'; did you mean 'vusfa'?"),
        ("table1 stages=[0.5,2]", "stages is [0.5, 2.0]; give shares of the training"),
        ("table1 experiment=../x", "a run cannot be called '../x'"),
        ("table1 launcher=slrum", "launcher is 'slrum': no such launcher; did you mean 'slurm'?"),
        ("tables nope", "results: no results of nope; there are none"),
        ("evaluate nope other", "nope: no such checkpoint"),
        ("scenes render-rooms x kind=bathrom", "no kind of room is called 'bathrom'; there are bathroom, "),
        ("pretrained show nope", "no pretrained agent is called 'nope'"),
        ("scenes fetch nope", "no archive is called 'nope'; there are thor-v1"),
    ],
)
def test_unknown_names_say_what_there_is(
    line: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, text = said(*line.split())
    assert code == 1
    assert text.startswith(words)
    assert not list(tmp_path.iterdir())


def test_results_that_are_there_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("table1/gvf-0", "hindsight/vusfa-0"):
        (tmp_path / "results" / name).mkdir(parents=True)
        (tmp_path / "results" / name / "cell.json").write_text("{}")
    assert said("tables", "tabel1")[1].endswith(
        "no results of tabel1; there are hindsight, table1; run vusfa table1 first"
    )
    words = "results/table1: no results of gvf-7; there are gvf-0"
    assert said("transfer", "run", "models=[gvf]", "seeds=[7]") == (1, words)
