"""The first signal is a wish, the second acts."""

from __future__ import annotations

import os
import signal
from functools import partial

import pytest

from vusfa.training import StopOnSignal


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_the_first_is_noted(number: int, code: int, request: pytest.FixtureRequest):
    # under nohup, hangups are ignored from the beginning
    request.addfinalizer(partial(signal.signal, signal.SIGHUP, signal.getsignal(signal.SIGHUP)))
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = [signal.getsignal(each) for each in numbers]
    with StopOnSignal() as stop:
        assert stop.exit_code == 0
        os.kill(os.getpid(), number)
        assert stop.received == number
        assert stop.exit_code == code
    assert [signal.getsignal(each) for each in numbers] == before


def test_the_second_acts_as_ever():
    def twice() -> None:
        with StopOnSignal():
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        twice()


def test_the_second_comes_out_as_an_interruption_whatever_a_library_made_of_it():
    def twice() -> None:
        with StopOnSignal():
            os.kill(os.getpid(), signal.SIGINT)
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt as interrupt:
                raise RuntimeError("autograd: a function failed") from interrupt

    with pytest.raises(KeyboardInterrupt):
        twice()


def test_other_errors_stay_what_they_are():
    with pytest.raises(ZeroDivisionError), StopOnSignal():
        raise ZeroDivisionError


def test_nohup_stays_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with StopOnSignal() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert stop.received is None
    assert signal.signal(signal.SIGHUP, before) == signal.SIG_IGN
