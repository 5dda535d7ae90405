"""``make bench``: its page, its result lines, the products it counts and its peers."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from tests.configs import ROOT
from tests.stages import fill, method_stage
from torchrl_etl.learners import StackedLearners

FOLDER = ROOT / "benchmarks"
NAMES = ("bench", "end_to_end", "floor", "harness", "machine", "peers", "seeds", "update")


@pytest.fixture(scope="module")
def benchmarks() -> Iterator[SimpleNamespace]:
    """The modules of the folder, imported as its scripts import them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        patch.setenv("OMP_NUM_THREADS", "1")  # which some of them set for the whole process
        modules = {name: __import__(name) for name in NAMES}
        yield SimpleNamespace(**modules)
        for name in modules:
            sys.modules.pop(name)


def test_tables_of_the_page_match_the_committed_results(benchmarks):
    bench = benchmarks.bench
    page = bench.PAGE.read_text(encoding="utf-8")
    assert bench.BEGIN + bench.table(bench.written()) + bench.END in page


def test_results_with_peers_record_cpu_threads_load_and_versions(benchmarks):
    with_peers = benchmarks.bench.WITH_PEERS
    rows = [row for row in benchmarks.bench.written() if row["benchmark"] in with_peers]
    assert {row["benchmark"] for row in rows} == set(with_peers)
    for row in rows:
        assert {"cpu_flags", "threads", "load_at_start", "torch"} <= row.keys()
        peers = {"jax", "sbx-rl", *(["stable_baselines3"] if row["benchmark"] != "start" else [])}
        assert peers <= row["peer_versions"].keys()


def test_peers_update_after_whole_steps_of_all_environments(benchmarks):
    end_to_end = benchmarks.end_to_end
    for frames_per_update in end_to_end.FRAMES_PER_UPDATE:
        for peer, at_once in end_to_end.peer_cases(frames_per_update).values():
            _, envs = end_to_end.PEERS[peer]
            assert frames_per_update * at_once % envs == 0  # whole steps of all environments


def test_result_has_ratios_to_peers_within_each_round(benchmarks, capsys):
    fast, slow = [1.0, 4.0, 3.0], [2.0, 8.0, 3.0]
    peers = {"slow": slow, "fast": fast}
    row = benchmarks.harness.line("update", "fast", "ms", fast, peers=peers, threads=1)
    assert row["median"] == 3.0 and row["ratios"] == {"slow": [0.5, 0.125]}
    assert row["threads"] == 1 and row["torch"] and row["load_at_start"] >= 0
    assert json.loads(capsys.readouterr().out) == row


@pytest.mark.parametrize(
    ("flags", "expected"),
    [("fpu avx avx2 fma", (True, False, False, False)), ("avx2 amx_tile", (True, 0, 0, True))],
)
def test_machine_facts_name_the_cpu_and_its_vector_instructions(
    flags, expected, benchmarks, tmp_path
):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor\t: 0\nmodel name\t: A CPU: new\nflags\t\t: {flags}\n\n")
    facts = benchmarks.machine.machine(cpuinfo)
    assert facts["cpu"] == "A CPU: new"
    names = ("avx2", "avx512f", "avx512_bf16", "amx")
    assert facts["cpu_flags"] == dict(zip(names, expected, strict=True))
    assert not any(benchmarks.machine.machine(tmp_path / "none")["cpu_flags"].values())


def test_floor_lists_the_matrix_products_of_an_mlp(benchmarks):
    products = benchmarks.floor.products(5, [2, 3, 1], "fwh")
    forward, weights = [(5, 2, 3), (5, 3, 1)], [(2, 5, 3), (3, 5, 1)]
    assert list(products) == [*forward, *weights, (5, 1, 3)]  # no gradient of the input


def test_updates_are_timed_as_training_makes_them(benchmarks):
    stage = method_stage("sac")
    fill(stage, 1)
    stage.progress.owed = 0.0
    benchmarks.harness.train(stage, 4, at_once=2)
    stage.close()
    assert stage.progress.updates == 4 and stage.progress.owed == 0


def test_seeds_are_timed_as_training_updates_them_together(benchmarks, monkeypatch):
    calls, updates = [], StackedLearners.updates
    monkeypatch.setattr(benchmarks.seeds, "AT_ONCE", 2)
    monkeypatch.setattr(
        StackedLearners,
        "updates",
        lambda self, inputs: calls.append(len(inputs[0])) or updates(self, inputs),
    )
    stages = [method_stage("sac", f"seed={seed}") for seed in (0, 1)]
    for stage in stages:
        fill(stage, 1)
        stage.progress.owed = 0.0
    values = benchmarks.seeds.measured(stages, repeats=1, block=4)
    for stage in stages:
        stage.close()
        assert stage.progress.updates == 2 * (4 + 4)  # a warm-up block and the recorded one
    assert calls == [2, 2] * 2
    assert [len(each) for each in values.values()] == [1, 1]
    assert min(values["together"] + values["one_by_one"]) > 0


def test_python_without_peers_is_refused_with_the_make_target(benchmarks, tmp_path):
    peer_python = benchmarks.peers.peer_python
    assert peer_python("none") is None
    with pytest.raises(SystemExit, match=r"not a Python that runs; `make .venv-peers/.complete`"):
        peer_python(tmp_path / "python")
    bare = tmp_path / "bare"
    bare.write_text(f'#!/bin/sh\nexec {sys.executable} -S -I "$@"\n')
    bare.chmod(0o755)
    with pytest.raises(SystemExit, match=r"has no stable_baselines3 and no sbx; `make .venv-peers"):
        peer_python(bare)


@pytest.mark.slow
@pytest.mark.parametrize("library", ["stable_baselines3", "sbx"])
def test_peer_prints_its_versions_and_milliseconds(library, benchmarks):
    try:
        python = benchmarks.peers.peer_python(benchmarks.peers.PYTHON)
    except SystemExit as error:
        pytest.skip(str(error))
    case = {"library": library, "updates_at_once": 2, "observation_dim": 3, "action_dim": 2}
    case |= {"hidden": [4], "batch_size": 2, "transitions": 4}
    command = [python, FOLDER / "peer_update.py", json.dumps(case)]
    done = subprocess.run(command, input="2\n", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    versions, answer = map(json.loads, done.stdout.splitlines())
    assert answer["ms"] > 0 and ("jax" in versions) == (library == "sbx")
