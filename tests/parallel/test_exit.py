"""Daemon threads that take steps while the interpreter ends."""

import pytest
from processes import run_python

# Program whose thread repeats steps; the main thread ends at once, or after a while.
_SCRIPT = """
    import sys, threading, time
    import torch
    import diffcloth_torch as dc

    cloths, bodies, robots = [dc.Cloth.grid(8, 8, size=0.2, pose=[0, 0, 0.12, 1, 0, 0, 0])], [], []
    if {robot}:
        robots = [dc.Robot.load(dc.robots.GRIPPER, base="floating", stiffness=100.0, damping=1.0)]
    sim = dc.Simulator(dc.Scene(cloths, bodies, robots), 0.01)
    started = threading.Event()

    def work():
        while True:
            x = sim.initial_state().positions.requires_grad_({backward})
            state = sim.rollout(sim.initial_state().replace(positions=x), steps=3)[-1]
            if {backward}:
                state.positions.sum().backward()
            started.set()

    threading.Thread(target=work, daemon=True).start()
    started.wait()
    time.sleep({delay})
    print("ended")
"""


@pytest.mark.quick("False-True-0.013", "True-True-0.031")
@pytest.mark.parametrize("delay", [0.0, 0.013, 0.031])
@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("robot", [False, True])
def test_the_process_ends_in_order(robot, backward, delay):
    # An abort is a return code of -6, which run_python refuses.
    script = _SCRIPT.format(robot=robot, backward=backward, delay=delay)
    assert run_python(script, timeout=120) == "ended\n"


@pytest.mark.slow
def test_an_idle_thread_does_not_hold_up_the_end():
    out = run_python(
        """
        import atexit, threading, time

        began = []
        atexit.register(lambda: print(time.monotonic() - began[0] < 1.0))  # runs after ours

        import diffcloth_torch as dc

        sim = dc.Simulator(dc.Scene([dc.Cloth.grid(4, 4, size=0.2)]), 0.01)
        done = threading.Event()

        def work():
            sim.step(sim.initial_state())
            done.set()
            time.sleep(1000)

        threading.Thread(target=work, daemon=True).start()
        done.wait()
        began.append(time.monotonic())
        """,
        timeout=120,
    )
    assert out == "True\n"
