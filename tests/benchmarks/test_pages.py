"""The speed page shows the committed measurements, which say of their machine what the page shows."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from benchmarks.machine import describe_machine
from benchmarks.pages import COMMAND, FACTS, document, documents, take_over
from benchmarks.report import Options, Report, Requirement, Row, write_reports
from benchmarks.run import MODULES
from vusfa.errors import ConfigError

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results" / "benchmarks"
REPORT = Report(
    "eval",
    [
        Row("ours", 1234.5, "frames/s", "theirs", 2.5, "a note", (1234.5, 1.0)),
        Row("theirs", 493.8, "frames/s"),
        Row("ours", 1234.5, "frames/s", "others", 0.5),
        Row("never", math.nan, "s"),
    ],
    [
        Requirement("fast enough", 2.5, 2.0, "times"),
        Requirement("solved", math.nan, 15.0, "s", at_least=False),
    ],
)


def test_the_page_shows_what_was_measured() -> None:
    made = documents(RESULTS)
    kept = {name: (ROOT / "docs" / "generated" / name).read_text(encoding="utf-8") for name in made}
    assert {name for name in made if made[name] != kept[name]} == set(), f"run {COMMAND}, and commit"
    page = (ROOT / "docs" / "speed.md").read_text(encoding="utf-8")
    assert [name for name in made if f"](generated/{name})\n" not in page] == []


def test_every_committed_report_is_a_full_one_of_a_suite_with_no_more_of_the_machine_than_needed() -> None:
    paths = sorted(RESULTS.glob("*"))
    assert {path.stem.removesuffix("-avx2") for path in paths} <= set(MODULES)
    for path in paths:
        content = json.loads(path.read_text(encoding="utf-8"))
        assert [suite["suite"] for suite in content["suites"]] == [path.stem.removesuffix("-avx2")]
        bfloat16 = {"avx512_bf16", "amx_bf16"} & set(content["machine"]["cpu_flags"])
        assert path.stem.endswith("-avx2") == (content["options"].get("avx2", False) or not bfloat16)
        assert not content["options"]["quick"]
        assert set(content["machine"]) == set(FACTS)
        assert "/work" not in path.read_text(encoding="utf-8")
        assert "/home" not in path.read_text(encoding="utf-8")


def test_a_report_is_taken_over_without_its_system_and_shown_with_its_failures(tmp_path: Path) -> None:
    machine = {**describe_machine(), "foreign_load": 0.1, "cpu_flags": ["avx2", "avx512_bf16"]}
    written = write_reports(
        tmp_path / "all.json", machine, Options(cap=60.0), [REPORT, Report("gpu", skipped="no device")]
    )
    (path,) = take_over(written, tmp_path / "results")
    assert path == tmp_path / "results" / "eval.json"
    assert machine["system"] not in path.read_text(encoding="utf-8")
    text = document(path)
    assert text.splitlines()[0] == "`python benchmarks/run.py --suite eval --cap 60`"
    assert f"commit {machine['commit']}. Other programs kept 0.1 cores busy" in text
    assert "| ours | 1,234 | frames/s | 2.5 × theirs, 0.5 × others |" in text
    assert text.count("| ours |") == 1
    assert "| never | not reached | s |  |" in text
    assert "- ours: a note" in text
    assert "| PASS | fast enough | 2.5 times | at least 2 |" in text
    assert "| **FAIL** | solved | not reached s | at most 15 |" in text
    assert (
        "Not measured with this version: `python benchmarks/run.py --suite gpu`"
        in documents(tmp_path)["speed-gpu.md"]
    )


def test_a_measurement_that_was_limited_to_avx2_stands_beside_the_other(tmp_path: Path) -> None:
    machine = {**describe_machine(), "foreign_load": 0.0, "cpu_flags": ["avx2", "amx_bf16"]}
    results = tmp_path / "results"
    for options in (Options(), Options(avx2=True)):
        take_over(write_reports(tmp_path / "eval.json", machine, options, [REPORT]), results)
    made = documents(results)
    assert "limited" not in made["speed-eval.md"]
    assert "`python benchmarks/run.py --suite eval --avx2`" in made["speed-eval-avx2.md"]
    assert "; torch, oneDNN and MKL limited to AVX2. Other programs" in made["speed-eval-avx2.md"]
    assert "speed-env-avx2.md" not in made


def test_a_processor_without_bfloat16_stands_beside_one_with_it(tmp_path: Path) -> None:
    results = tmp_path / "results"
    for flags in (["avx2"], ["avx2", "avx512f", "avx512_bf16"]):
        machine = {**describe_machine(), "foreign_load": 0.0, "cpu_flags": flags}
        take_over(write_reports(tmp_path / "eval.json", machine, Options(), [REPORT]), results)
    assert sorted(path.name for path in results.iterdir()) == ["eval-avx2.json", "eval.json"]
    text = documents(results)["speed-eval-avx2.md"]
    assert "(avx2), " in text
    assert "`python benchmarks/run.py --suite eval`" in text
    assert "limited" not in text


def test_a_quick_or_foreign_file_is_refused(tmp_path: Path) -> None:
    machine = {**describe_machine(), "foreign_load": 0.0}
    quick = write_reports(tmp_path / "quick.json", machine, Options(quick=True), [REPORT])
    (tmp_path / "other.json").write_text("[1]")
    for path, words in (
        (quick, "written with --quick"),
        (tmp_path / "other.json", "is no report"),
        (tmp_path / "none.json", "is no report of benchmarks/run.py"),
    ):
        with pytest.raises(ConfigError, match=words):
            take_over(path, tmp_path / "results")
    assert not (tmp_path / "results").exists()
