"""Critical sections: Ctrl-C waits outside, a second thread is refused; and shared work is over when the call is."""

import copy
import os
import signal
import threading
import time

import casadi as ca
import numpy as np
import pytest

from ce_gym.compile import Buffer, Call, CriticalSection, Program, load_kernel
from ce_gym.compile.threads import run_chunks


def interrupt():
    """Have Ctrl-C come now; returns when it has been delivered to this process."""
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_waits_for_the_end():
    done = []
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012  (what comes before it is the point)
        with CriticalSection("a"):
            interrupt()
            done.append(1)
        done.append(2)
    assert done == [1]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_it_waits_for_the_end_of_the_outermost():
    done = []
    with pytest.raises(KeyboardInterrupt), CriticalSection("a"):  # noqa: PT012
        with CriticalSection("b") as inner:
            interrupt()
            inner.interruption_point()
            done.append(1)
        done.append(2)
    assert done == [1, 2]


def test_it_comes_where_an_interruption_is_in_order():
    done, section = [], CriticalSection("a")
    with pytest.raises(KeyboardInterrupt), section:  # noqa: PT012
        section.interruption_point()
        interrupt()
        done.append(1)
        section.interruption_point()
        done.append(2)
    assert done == [1]
    with section:
        section.interruption_point()


def test_a_handler_that_goes_on_is_called_once_and_stays():
    calls, section = [], CriticalSection("a")

    def handler(number, frame):
        calls.append(number)

    before = signal.signal(signal.SIGINT, handler)
    try:
        with section:
            interrupt()
            assert calls == []
            section.interruption_point()
            assert calls == [signal.SIGINT]
        with section:
            interrupt()
        assert calls == [signal.SIGINT] * 2
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("handler", [signal.SIG_IGN, signal.SIG_DFL])
def test_what_python_does_not_handle_is_left_alone(handler):
    before = signal.signal(signal.SIGINT, handler)
    try:
        with CriticalSection("a"):
            assert signal.getsignal(signal.SIGINT) is handler
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_second_thread_is_refused_and_the_first_is_not_harmed():
    section, errors = CriticalSection("Simulator of 3 dogs"), []

    def enter():
        try:
            with section:
                errors.append(None)
        except RuntimeError as error:
            errors.append(str(error))

    for expected in ("Simulator of 3 dogs: called during another call, expected one call at a time", None):
        with section if expected else CriticalSection("another"):
            thread = threading.Thread(target=enter)
            thread.start()
            thread.join()
        assert errors.pop() == expected


def test_a_refusal_in_the_main_thread_gives_ctrl_c_back():
    section = CriticalSection("a")
    inside, leave = threading.Event(), threading.Event()

    def stay():
        with section:
            inside.set()
            leave.wait()

    thread = threading.Thread(target=stay)
    thread.start()
    inside.wait()
    with pytest.raises(RuntimeError, match="one call at a time"), section:
        pass
    leave.set()
    thread.join()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_copy_is_a_section_of_its_own():
    section = CriticalSection("a")
    with section, copy.deepcopy(section):
        pass


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_child_forked_during_a_section_hears_ctrl_c():
    """As `multiprocessing` forks, from a thread, while the main thread is in a step."""
    heard = []

    def fork():
        child = os.fork()
        if child == 0:
            os._exit(0 if signal.getsignal(signal.SIGINT) is signal.default_int_handler else 1)
        heard.append(os.waitpid(child, 0)[1])

    with CriticalSection("a"):
        thread = threading.Thread(target=fork)
        thread.start()
        thread.join()
    assert heard == [0]


def doubling(name):
    x = ca.SX.sym("x", 1)
    call = Call(ca.Function("double", [x], [2 * x]), ("x",), ("x",))
    return Program(name, (Buffer("x", 1, "tiles"),), (call,))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_child_forked_during_a_compilation_compiles():
    begun = threading.Event()

    def slowly():
        begun.set()
        time.sleep(0.3)
        return doubling("of the parent")

    thread = threading.Thread(target=load_kernel, args=("fork, parent", slowly))
    thread.start()
    begun.wait()
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # ends a child that waits for ever
        load_kernel("fork, child", lambda: doubling("of the child"))
        os._exit(0)
    thread.join()
    assert os.waitpid(child, 0)[1] == 0


def test_every_part_is_worked_on_once():
    for count, num_threads in ((1, 4), (2, 2), (7, 3), (100, 8)):
        times = np.zeros(count, int)

        def work(first, end, times=times):
            times[first:end] += 1

        run_chunks(work, count, num_threads)
        assert (times == 1).all()


def test_nobody_works_any_more_when_ctrl_c_is_raised():
    """It comes while the main thread has done its part and waits for another one's."""
    done = []

    def work(first, end):
        if first:
            while not done:  # the first part, and then Ctrl-C for a thread that waits
                time.sleep(0.001)
            time.sleep(0.05)
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            time.sleep(0.2)
        done.append(first)

    with pytest.raises(KeyboardInterrupt):
        run_chunks(work, 2, 2)
    assert done == [0, 1]


def test_nobody_works_any_more_when_a_part_fails():
    done = []

    def work(first, end):
        if first == 0:
            raise ZeroDivisionError
        time.sleep(0.1)
        done.append(first)

    with pytest.raises(ZeroDivisionError):
        run_chunks(work, 2, 2)
    now = list(done)
    time.sleep(0.2)
    assert done == now


def test_an_error_of_another_thread_is_raised():
    def work(first, end):
        if first:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_chunks(work, 2, 2)


def test_parts_that_no_thread_has_begun_are_done_here():
    """All threads are busy with another call, which ends only after this one."""
    end_of_other = threading.Event()
    others = [threading.Thread(target=run_chunks, args=(lambda *_: end_of_other.wait(), 64, 64))]
    others[0].start()
    times = np.zeros(4, int)

    def work(first, end):
        times[first:end] += 1

    try:
        run_chunks(work, 4, 4)
        assert times.tolist() == [1, 1, 1, 1]
    finally:
        end_of_other.set()
        others[0].join()
