"""Tasks on an executor, with who asks for results as one more worker; and what a trial's listeners may keep."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from mape_runs import GRID, Corridor, config, corridor_loop

from adapters.systems import make_system
from mape.execute.uniforms import Uniforms
from mape.trials import each_completed, run_trial

PATIENCE = 60.0


@pytest.mark.parametrize("here", [None, pow])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 20])
@pytest.mark.parametrize("threads", [1, 3])
def test_each_task_is_worked_on_once(threads, count, here):
    with ThreadPoolExecutor(threads) as executor:
        found = list(each_completed(executor, pow, ((k, 2) for k in range(count)), in_flight=2 * threads, here=here))
    assert sorted(found) == [k * k for k in range(count)]


@pytest.mark.parametrize("others", [1, 3])
def test_as_many_tasks_as_workers_are_worked_on_at_once_by_all_of_them(others):
    all_at_work = threading.Barrier(others + 1, timeout=PATIENCE)

    def work():
        all_at_work.wait()
        return threading.get_ident()

    with ThreadPoolExecutor(others) as executor:
        tasks = [() for _ in range(others + 1)]
        found = list(each_completed(executor, work, tasks, in_flight=2 * others, here=work))
    assert found.count(threading.get_ident()) == 1
    assert len(set(found)) == others + 1


def test_no_task_is_begun_after_one_has_failed_here():
    begun, other_at_work, released = [], threading.Event(), threading.Event()

    def work(k):
        begun.append(k)
        if threading.current_thread() is threading.main_thread():
            assert other_at_work.wait(PATIENCE)
            raise ValueError(f"task {k} fails")
        other_at_work.set()
        assert released.wait(PATIENCE)

    with ThreadPoolExecutor(1) as executor:
        with pytest.raises(ValueError, match="task 0 fails"):
            list(each_completed(executor, work, [(k,) for k in range(9)], in_flight=2, here=work))
        released.set()
    assert sorted(begun) == [0, 1]


@pytest.mark.parametrize("engine", ["auto", "python"])
def test_rows_that_a_listener_keeps_stay_as_they_were(engine):
    kept, copied = [], []
    run_trial(
        config(GRID, episodes=1200, execute={"engine": engine}),
        0,
        make_system,
        on_rows=kept.append,
        prepare=lambda loop: loop.log.on_rows(lambda rows: copied.append(rows.copy())),
    )
    assert np.concatenate(kept)["pass"].tolist() == list(range(1, 1201))
    assert np.concatenate(kept).tobytes() == np.concatenate(copied).tobytes()


def test_the_uniforms_that_a_system_keeps_stay_as_they_were():
    system = Corridor()
    system.draws = (2, 1)
    loop = corridor_loop(system)
    loop.run(1100)
    stream = Uniforms(0, (0, 0), loop.execute.uniforms.width)
    for episode in system.begun:
        at = stream.find(episode.number - 1)
        assert episode.uniforms.tolist() == stream.values[at : at + 2 + system.max_steps].tolist()


def test_traced_steps_that_a_listener_keeps_stay_as_they_were():
    kept, copied = [], []
    loop = corridor_loop()
    loop.execute.record_trace(1, 30, lambda number, steps: (kept.append(steps), copied.append(steps.copy())))
    loop.run(40)
    assert [steps.tolist() for steps in kept] == [steps.tolist() for steps in copied]
    assert len(kept) == 30
