"""An interrupt ends a command, whoever swallows it."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time

import pytest

from ms_slam_env._runtime.command_line import exit_code
from ms_slam_env._runtime.interrupts import Interrupts, kept, recorded

pytestmark = pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs POSIX signals")


@pytest.fixture(autouse=True)
def default_handlers():
    """Those that Python starts with; a shell's background job inherits others."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    before = [signal.getsignal(number) for number in numbers]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    mine = [signal.getsignal(number) for number in numbers]
    yield
    assert [signal.getsignal(number) for number in numbers] == mine
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)


def swallow(number):
    """What trimesh does at its imports."""
    try:
        os.kill(os.getpid(), number)
        time.sleep(5)
    except BaseException:
        pass


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("times", [1, 3])
def test_a_swallowed_signal_comes_again(number, code, times, capsys):
    def run():
        swallow(number)
        for _ in range(times - 1):
            with contextlib.suppress(BaseException):
                time.sleep(5)
        time.sleep(20)
        return 0

    start = time.monotonic()
    assert exit_code(run) == code
    assert time.monotonic() - start < 5
    by = " by SIGTERM" if number == signal.SIGTERM else ""
    assert capsys.readouterr().err == f"ms-slam: interrupted{by}\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_is_recorded_by_the_name_of_its_signal(number):
    said = []

    def run():
        try:
            os.kill(os.getpid(), number)
            time.sleep(5)
        except BaseException as error:
            said.append(recorded(error))
            raise

    assert exit_code(run) == 128 + number
    assert said == [f"interrupted by {number.name}"]
    assert [recorded(ValueError("no")), recorded(MemoryError())] == ["no", "MemoryError"]


def test_what_is_done_about_an_interrupt_is_not_interrupted_by_the_same(capsys):
    done = []

    def run():
        try:
            with kept("half of it is kept"):
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(5)
        finally:
            for part in range(10):
                try:
                    raise KeyError("an error of its own, handled on the way")
                except KeyError:
                    time.sleep(0.06)
                done.append(part)
        return 0

    assert exit_code(run) == 143
    assert done == list(range(10))
    assert capsys.readouterr().err == "ms-slam: interrupted by SIGTERM; half of it is kept\n"


def test_a_second_signal_interrupts_what_the_first_set_off():
    def run():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        finally:
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
            time.sleep(20)
        return 0

    start = time.monotonic()
    assert exit_code(run) == 130
    assert time.monotonic() - start < 5


def test_what_a_broken_library_makes_of_an_interrupt_is_one(capsys):
    def run():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
        except KeyboardInterrupt:
            raise ImportError("numpy.core.multiarray failed to import") from None
        return 0

    assert exit_code(run) == 130
    assert capsys.readouterr().err == "ms-slam: interrupted\n"


def test_a_signal_that_is_ignored_stays_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as under nohup
    with Interrupts() as interrupts:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
    assert interrupts.signal is None
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    signal.signal(signal.SIGINT, signal.default_int_handler)


def test_in_another_thread_nothing_changes():
    codes = []
    thread = threading.Thread(target=lambda: codes.append(exit_code(lambda: 5)))
    thread.start()
    thread.join()
    assert codes == [5]
