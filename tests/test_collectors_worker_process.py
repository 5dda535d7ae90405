"""Signals to all processes of a run and multiprocessing's resource tracker."""

from __future__ import annotations

import subprocess
import sys

import pytest

from torchrl_etl.collectors import worker_process

LOCKS_AND_A_SIGNAL = """
import importlib.util, multiprocessing, os, signal, sys, time
number = signal.Signals[sys.argv[2]]
spec = importlib.util.spec_from_file_location("worker_process", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
os.setpgid(0, 0)
module.start_resource_tracker()
lock = multiprocessing.get_context("spawn").Lock()
signal.signal(number, signal.SIG_IGN)
os.killpg(0, number)
time.sleep(0.2)
del lock
"""


@pytest.mark.parametrize("name", ["SIGUSR1", "SIGHUP", "SIGTERM", "SIGINT"])
def test_resource_tracker_survives_signals_to_the_process_group(name):
    command = [sys.executable, "-c", LOCKS_AND_A_SIGNAL, worker_process.__file__, name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert not done.stderr
