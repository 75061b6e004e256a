# SPDX-License-Identifier: Apache-2.0
"""Calls spread over processes: what is prepared, what dies, what is refused, and that nobody is left over."""

import os
import sys
import time
from concurrent.futures import wait
from concurrent.futures.process import BrokenProcessPool

import calls
import pytest

from warpmpc import SceneError
from warpmpc.loop.run import workers as module
from warpmpc.loop.run.workers import LocalWorkers, one_thread, open_workers


@pytest.fixture(scope="module")
def two():
    with LocalWorkers(2, prepare=calls.prepare) as workers:
        yield workers


def test_as_many_calls_run_at_once_as_there_are_processes(two, tmp_path):
    futures = [two.submit(calls.meet, str(tmp_path), name, 1) for name in "ab"]
    processes = {future.result() for future in futures}
    assert len(processes) == 2
    assert os.getpid() not in processes


def test_a_process_is_prepared_once_and_stays(two):
    seen = [two.submit(calls.where).result() for _ in range(6)]
    assert {prepared for _, prepared, _ in seen} == {1}
    assert len({process for process, _, _ in seen}) <= 2


def test_what_calls_print_is_not_seen(two, capfd):
    assert two.submit(calls.chat).result() == 1
    assert capfd.readouterr() == ("", "")


def test_an_error_arrives_as_it_was_raised(two):
    with pytest.raises(SceneError) as error:
        two.submit(calls.refuse).result()
    assert str(error.value) == "some.toml: planner.samples: is wrong; found 'x'; allowed: y"


def test_a_process_that_dies_takes_all_queued_along_those_that_come_later_too(tmp_path):
    with LocalWorkers(1) as workers:
        queued = [workers.submit(calls.die, str(tmp_path)), workers.submit(calls.where)]
        for call in queued:
            assert isinstance(call.exception(timeout=60.0), BrokenProcessPool)
        assert isinstance(workers.submit(calls.where).exception(timeout=60.0), BrokenProcessPool)
    assert len(list(tmp_path.iterdir())) == 1


def test_why_a_process_cannot_be_prepared_is_told():
    with (
        LocalWorkers(1, prepare=calls.refuse) as workers,
        pytest.raises(SceneError, match="samples: is wrong"),
    ):
        workers.submit(calls.where).result(timeout=60.0)


def test_leaving_ends_calls_at_once(tmp_path):
    mark = tmp_path / "mark"
    with LocalWorkers(1) as workers:
        running, queued = workers.submit(calls.sleep, str(mark)), workers.submit(calls.where)
        while not mark.exists():
            time.sleep(0.05)
    assert isinstance(running.exception(timeout=20.0), BrokenProcessPool)
    wait([queued], timeout=20.0)
    assert queued.cancelled() or isinstance(queued.exception(), BrokenProcessPool)
    end = time.monotonic() + 20.0
    while not calls.gone(int(mark.read_text())):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_each_gpu_has_a_process_that_sees_it_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_gpus", lambda: ["3", "GPU-5"])
    workers, device = open_workers("gpus")
    with workers:
        futures = [workers.submit(calls.meet_where, str(tmp_path), name, 1) for name in "ab"]
        seen = {future.result()[2] for future in futures}
    assert (workers.count, device) == (2, "cuda:0")
    assert seen == {"3", "GPU-5"}


def test_gpus_are_named_as_this_process_sees_them(monkeypatch):
    import warp as wp

    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert module._gpus() == ["0", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4, 6")
    assert module._gpus() == ["4", "6"]


@pytest.mark.parametrize("where", ["0", "-1", "2.5", "", "cores", "ray:", "rays", "ray:x", "gpus:2"])
def test_a_place_that_does_not_exist_is_refused(where):
    with pytest.raises(ValueError, match=r"^--jobs") as error:
        open_workers(where)
    assert "\n" not in str(error.value)


def test_gpus_that_are_not_there_or_asked_for_twice_are_refused(monkeypatch):
    monkeypatch.setattr(module, "_gpus", list)
    with pytest.raises(ValueError, match="no GPU here"):
        open_workers("gpus")
    with pytest.raises(ValueError, match="leave out --device, not 'cpu'"):
        open_workers("gpus", device="cpu")


def test_a_cluster_without_ray_is_refused_with_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install 'warpmpc\[cluster\]'"):
        open_workers("ray")


def test_calls_that_share_a_machine_take_a_thread_each(two):
    assert one_thread(two, ["a=1"]) == ("a=1", "engine.threads=1")
    with LocalWorkers(1) as alone:
        assert one_thread(alone, ["a=1"]) == ("a=1",)
