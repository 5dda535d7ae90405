"""Seeds in separate processes give the same runs as each seed alone."""

from __future__ import annotations

import os
import signal
import subprocess

from tests.commands import begun, wait_until
from tests.configs import ROOT, TINY, tiny
from tests.runs import has_saved, numbers
from torchrl_etl.experiment import Experiment
from torchrl_etl.in_processes import _sendable, in_processes

SHORT = ("frames=416", "explore.frames=224", "evaluation.episodes=1")


def test_each_process_equals_a_single_run_and_survives_a_failed_one(tmp_path, capfd):
    configs = [tiny(f"run_dir='{tmp_path}/{seed}'", f"seed={seed}", *SHORT) for seed in (0, 1)]
    (tmp_path / "1").write_text("a file where the folder should be")
    ends = in_processes([{"config": each, "resume": None, "say": print} for each in configs])
    assert f"Run folder: {tmp_path}/0" in capfd.readouterr().out
    (folder, summary), (_, fault) = ends
    assert folder == tmp_path / "0" and summary["seed"] == 0
    assert isinstance(fault, OSError) and str(tmp_path / "1") in str(fault)
    Experiment(tiny(f"run_dir='{tmp_path}/alone'", "seed=0", *SHORT)).run()
    assert numbers(folder) == numbers(tmp_path / "alone")


class Broken(Exception):
    def __init__(self, joint, angle):
        super().__init__(f"{joint} at {angle}")


def test_an_error_that_cannot_be_made_again_is_told_in_its_words():
    assert str(_sendable(Broken("knee", 3))) == "Broken: knee at 3"
    assert isinstance(_sendable(OSError("full")), OSError)


def children(process: int) -> list[int]:
    command = ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(process)]
    listed = subprocess.run(command, capture_output=True, text=True).stdout
    return [int(line.split()[0]) for line in listed.splitlines() if "spawn_main" in line]


def test_killed_process_and_sigint_are_reported_with_how_to_resume(tmp_path):
    arguments = [*TINY, "method=sac", "frames=100000", "seeds=[0,1]", f"run_dir='{tmp_path}/run'"]
    running = begun("etl_sac.py", *arguments, cwd=tmp_path)
    folders = [tmp_path / "run" / f"seed{seed}" for seed in (0, 1)]
    wait_until(lambda: all(has_saved(folder, "learn") for folder in folders), running)
    killed, _ = children(running.pid)
    os.kill(killed, signal.SIGKILL)
    running.send_signal(signal.SIGINT)
    output, _ = running.communicate(timeout=100)
    assert running.returncode == 130
    assert (
        f"The process of {folders[0]} ended with exit code -9; continue with resume={folders[0]}."
        in output
    )
    assert (
        f"Stopped and saved. To continue: python {ROOT}/recipes/etl_sac.py resume={folders[1]}"
        in (output)
    )
    assert "Traceback" not in output
