# SPDX-License-Identifier: Apache-2.0
"""Calls and whole episodes on a Ray cluster of two nodes, both on this machine, with processes and nodes that die.

Slow ones by hand: pytest -m slow tests/loop/run/test_ray_workers.py
"""

import contextlib
import json
import os
import signal
import sys
import time

import calls
import pytest
from needs import reason

pytest.importorskip("ray", reason=reason("ray"))

from concurrent.futures.process import BrokenProcessPool

import ray
import warp as wp
from program import SCENE, TINY
from program import untimed as without_times
from ray.cluster_utils import Cluster
from shared.jobs import Job, run_job
from studies.paper import reproduce

from warpmpc import SceneError
from warpmpc.cli.main import app
from warpmpc.loop.run import ray_workers
from warpmpc.loop.run.ray_workers import RayWorkers
from warpmpc.loop.run.workers import open_workers

CPUS = {"num_cpus": 1, "object_store_memory": 80_000_000}


@pytest.fixture(scope="module")
def cluster():
    """Two nodes of one core each; their processes find what these tests find."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        made = Cluster(initialize_head=True, head_node_args={**CPUS, "include_dashboard": False})
        made.add_node(**CPUS)
        made.wait_for_nodes()
        patch.setenv("RAY_ADDRESS", made.address)
        yield made
        ray.shutdown()
        made.shutdown()


@pytest.fixture(scope="module")
def both(cluster):
    with RayWorkers(cluster.address, prepare=calls.prepare) as workers:
        yield workers


def test_both_nodes_make_calls_at_once(both, tmp_path):
    assert both.count == 2
    futures = [both.submit(calls.meet, str(tmp_path), name, 1) for name in "ab"]
    assert len({future.result(timeout=90.0) for future in futures} - {os.getpid()}) == 2


def test_a_process_is_prepared_once_and_sees_no_gpu(both):
    seen = [both.submit(calls.where).result(timeout=90.0) for _ in range(4)]
    assert {(prepared, gpus) for _, prepared, gpus in seen} == {(1, "")}


def test_an_error_arrives_as_it_was_raised(both):
    with pytest.raises(SceneError) as error:
        both.submit(calls.refuse).result(timeout=90.0)
    assert str(error.value) == "some.toml: planner.samples: is wrong; found 'x'; allowed: y"


def test_a_call_whose_process_dies_is_made_again(both, tmp_path):
    futures = [both.submit(calls.die_once, str(tmp_path), value) for value in range(2)]
    assert [future.result(timeout=90.0) for future in futures] == [0, 1]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_call_that_kills_every_process_is_given_up(both, tmp_path):
    with pytest.raises(BrokenProcessPool, match="died"):
        both.submit(calls.die, str(tmp_path)).result(timeout=120.0)
    assert len(list(tmp_path.iterdir())) == 3


def test_other_sources_on_a_node_are_refused(cluster, monkeypatch):
    monkeypatch.setattr(ray_workers, "code_digest", lambda: "another")
    ray.shutdown()  # processes of an earlier program are not asked again
    with RayWorkers() as workers, pytest.raises(ValueError, match="other sources of warpmpc") as error:
        workers.submit(calls.where).result(timeout=90.0)
    assert "\n" not in str(error.value)


def test_a_session_of_the_users_own_goes_on_without_the_calls(cluster, tmp_path):
    ray.shutdown()
    with contextlib.chdir("/"):  # else nodes import warpmpc from the folder of the tests
        ray.init(address=cluster.address, log_to_driver=False)
    try:
        with pytest.raises(ValueError, match=r"has joined the cluster at .*, not the one at 127\.0\.0\.1:1"):
            RayWorkers("127.0.0.1:1")
        marks = [tmp_path / name for name in "ab"]
        with RayWorkers(cluster.address) as workers:
            futures = [workers.submit(calls.sleep, str(mark)) for mark in marks]
            queued = workers.submit(calls.where)
            while not all(mark.exists() for mark in marks):
                assert not any(future.done() and future.result() for future in futures)
                time.sleep(0.05)
        assert ray.is_initialized()
        end = time.monotonic() + 60.0
        while not all(calls.gone(int(mark.read_text())) for mark in marks):
            assert time.monotonic() < end
            time.sleep(0.05)
        while not all(future.cancelled() for future in (*futures, queued)):  # Ray reports the end in a separate thread
            assert time.monotonic() < end
            time.sleep(0.05)
        with RayWorkers() as workers:  # whose cores are free again
            assert workers.submit(calls.where).result(timeout=90.0)[1] == 0
    finally:
        ray.shutdown()


@pytest.mark.parametrize("address", ["127.0.0.1:1", "no.such.host.invalid:6379"])
def test_a_cluster_that_is_not_there_is_one_message(address):
    with pytest.raises(ValueError, match=f"no cluster at {address}; start one") as error:
        open_workers(f"ray:{address}")
    assert "\n" not in str(error.value)


def test_a_cluster_without_gpus_is_refused_for_plans_on_one(cluster):
    with pytest.raises(ValueError, match="the cluster has no GPU"):
        open_workers("ray", device="cuda:0")


def untimed(record: dict) -> dict:
    """What a run came to, without wall times."""
    return json.loads(json.dumps({"result": without_times(record["result"]), "measured": record["measured"]}))


@pytest.mark.slow
def test_a_table_is_that_of_one_process_number_by_number(cluster, tmp_path):
    args = ["table4/box_A", "--engine", "mujoco", "--device", "cpu", "--out", str(tmp_path), *TINY]
    assert not reproduce.main([*args, "--jobs", "ray", "--runs", "2"])
    records = [json.loads(line) for line in (tmp_path / "table4.jsonl").read_text().splitlines()]
    assert sorted(record["seed"] for record in records) == [0, 1]
    for record in records:
        job = Job(
            scene="omni_push_box:A", seed=record["seed"], overrides=tuple(TINY[1::2]), engine="mujoco", device="cpu"
        )
        assert untimed(record) == untimed(run_job(job))


def test_the_command_runs_episodes_on_a_cluster_and_keeps_their_results(cluster, tmp_path, capfd, monkeypatch):
    (tmp_path / "mine.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    args = ["run", "mine.toml:near", "--episodes", "2", "--engine", "mujoco", "--json", *TINY]
    found = []
    for more in (["--jobs", "ray", "--results", "r.jsonl", "--csv", "a.csv"], ["--results", "r.jsonl"], []):
        with pytest.raises(SystemExit):
            app([*args, *more], prog_name="warpmpc")
        lines = capfd.readouterr().out.splitlines()
        found.append(sorted(map(json.loads, lines), key=lambda result: result["seed"]))
    spread, kept, alone = found
    assert kept == spread
    assert list(map(without_times, spread)) == list(map(without_times, alone))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-0.csv", "a-1.csv", "mine.toml", "r.jsonl"]


def test_a_process_killed_in_the_middle_of_its_call_changes_nothing(cluster, tmp_path):
    mark = tmp_path / "mark"
    with RayWorkers() as workers:
        future = workers.submit(calls.linger_once, str(mark), 5)
        while not mark.exists():
            time.sleep(0.05)
        os.kill(int(mark.read_text()), signal.SIGKILL)
        assert future.result(timeout=90.0) == 5


def test_a_node_that_is_lost_has_its_calls_made_on_another(cluster, tmp_path):
    with RayWorkers() as workers:
        lost = cluster.add_node(num_cpus=1, resources={"third": 1}, object_store_memory=80_000_000)
        cluster.wait_for_nodes()
        marks = [tmp_path / str(i) for i in range(3)]
        futures = [workers.submit(calls.linger_once, str(mark), i) for i, mark in enumerate(marks)]
        while not all(mark.exists() for mark in marks):
            time.sleep(0.05)
        cluster.remove_node(lost, allow_graceful=False)
        for mark in marks:  # those that did not run there need not stay
            mark.with_suffix(".go").touch()
        assert [future.result(timeout=120.0) for future in futures] == [0, 1, 2]
