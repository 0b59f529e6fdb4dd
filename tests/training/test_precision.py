"""autocast=auto: bfloat16 where it is faster, with both answers of the hardware and of the clock."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from vusfa.errors import ConfigError
from vusfa.experiments.training import compose_settings
from vusfa.training import Trainer, load_checkpoint, make_trainer, precision, run_facts
from vusfa.training.precision import resolve_autocast


@pytest.fixture(autouse=True)
def _measured_anew() -> None:
    precision._is_faster.cache_clear()


def has_units(monkeypatch: pytest.MonkeyPatch, **flags: bool) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True, **flags})


def takes(monkeypatch: pytest.MonkeyPatch, bfloat16: float, float32: float = 1.0) -> list[torch.dtype]:
    """The clock says so many seconds; the list fills with the products that were measured."""
    asked = []

    def seconds(factors: tuple[torch.Tensor, torch.Tensor]) -> float:
        asked.append(factors[0].dtype)
        return bfloat16 if factors[0].dtype == torch.bfloat16 else float32

    monkeypatch.setattr(precision, "_seconds", seconds)
    return asked


@pytest.mark.parametrize("setting", [True, False])
def test_a_chosen_precision_is_not_measured(monkeypatch: pytest.MonkeyPatch, setting: bool) -> None:
    asked = takes(monkeypatch, bfloat16=1.0)
    assert resolve_autocast(setting) is setting
    assert not asked


@pytest.mark.parametrize(("bfloat16", "expected"), [(0.2, True), (0.9, False), (10.0, False)])
def test_the_clock_decides_where_there_are_units(
    monkeypatch: pytest.MonkeyPatch, bfloat16: float, expected: bool
) -> None:
    has_units(monkeypatch, avx512_bf16=True)
    asked = takes(monkeypatch, bfloat16)
    assert resolve_autocast("auto") is expected
    assert resolve_autocast("auto", torch.device("cpu")) is expected
    assert len(asked) == 2 * precision.REPEATS  # once per process
    assert {torch.float32, torch.bfloat16} == set(asked)


def test_without_units_nothing_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    has_units(monkeypatch, avx512_bf16=False, amx_bf16=False)
    asked = takes(monkeypatch, bfloat16=0.1)
    assert resolve_autocast("auto") is False
    assert not asked


def test_the_clock_decides_where_torch_cannot_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    has_units(monkeypatch)
    takes(monkeypatch, bfloat16=0.1)
    assert resolve_autocast("auto") is True


@pytest.mark.parametrize("supported", [True, False])
def test_a_gpu_says_it_itself(monkeypatch: pytest.MonkeyPatch, supported: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: supported)
    assert resolve_autocast("auto", "cuda") is supported


def test_other_devices_compute_in_float32() -> None:
    assert resolve_autocast("auto", "meta") is False


def test_a_processor_limited_to_avx2_computes_in_float32() -> None:
    """The clock alone finds what the flags do not say: here oneDNN may not use the processor's units."""
    program = "from vusfa.training.precision import resolve_autocast; print(resolve_autocast('auto'))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "ONEDNN_MAX_CPU_ISA": "AVX2"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize("setting", ["yes", "off", 1, None])
def test_any_other_setting_is_refused(setting: object) -> None:
    with pytest.raises(ConfigError, match=r"^autocast is .*; give true, false or auto$"):
        resolve_autocast(setting)  # type: ignore[arg-type]


@pytest.mark.parametrize("faster", [True, False])
def test_a_training_keeps_what_auto_meant_at_its_start(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scene_file: Path, faster: bool
) -> None:
    """Another machine's answer changes nothing in a resumed run; true and false do."""
    small = [
        f"scenes=[{scene_file}]",
        "agent.hidden_size=8",
        "agent.embedding_size=8",
        "collector.num_envs=5",
        f"folder={tmp_path}",
    ]

    def made(*overrides: str) -> Trainer:
        settings: Any = OmegaConf.to_container(compose_settings([*small, "collector.rollout=4", *overrides]))
        return make_trainer(settings)

    has_units(monkeypatch, amx_bf16=True)
    takes(monkeypatch, bfloat16=0.1 if faster else 10.0)
    trainer = made()
    assert trainer.settings["autocast"] is faster
    with trainer.collecting():
        path = trainer.save(tmp_path / "checkpoint.pt")
    assert load_checkpoint(path)["config"]["autocast"] is faster
    assert run_facts(load_checkpoint(path))["precision"] == ("bfloat16" if faster else "float32")
    monkeypatch.setattr(precision, "_is_faster", lambda: not faster)
    assert resolve_autocast("auto") is not faster
    resumed = made(f"resume={path}")
    assert resumed.settings["autocast"] is faster
    assert resumed.resume(path) == []
    for setting in (True, False):
        assert made(f"resume={path}", f"autocast={str(setting).lower()}").settings["autocast"] is setting
