"""The first signal is a wish, the second acts."""

from __future__ import annotations

import os
import signal

import pytest

from vusfa.training import StopOnSignal


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_first_is_noted(number: int, code: int):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with StopOnSignal() as stop:
        assert stop.exit_code == 0
        os.kill(os.getpid(), number)
        assert stop.received == number
        assert stop.exit_code == code
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_the_second_acts_as_ever():
    def twice() -> None:
        with StopOnSignal():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        twice()
