"""autocast=auto: bfloat16 where it is faster, with both answers of the hardware and of the clock."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest
import torch

from vusfa.errors import ConfigError
from vusfa.training import precision
from vusfa.training.precision import describe_autocast, resolve_autocast


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
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "ONEDNN_MAX_CPU_ISA": "AVX2"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "False"
    assert time.monotonic() - began < 60


@pytest.mark.parametrize("setting", ["yes", "off", 1, None])
def test_any_other_setting_is_refused(setting: object) -> None:
    with pytest.raises(ConfigError, match=r"^autocast is .*; give true, false or auto$"):
        resolve_autocast(setting)  # type: ignore[arg-type]


def test_the_run_says_its_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    has_units(monkeypatch, avx512_bf16=False)
    assert describe_autocast("auto") == "float32 (autocast=auto: bfloat16 is no faster on this cpu)"
    has_units(monkeypatch, amx_bf16=True)
    takes(monkeypatch, bfloat16=0.1)
    assert describe_autocast("auto") == "bfloat16 (autocast=auto: bfloat16 is faster on this cpu)"
