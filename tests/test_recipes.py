"""Recipes from the command line: on MyoSuite models, with mistyped arguments, as processes.

Output and files of a recipe are the same in its own process and in this one (see :func:`command`),
where everything is imported already, so only a few tests start a process.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.commands import begun, command, process, wait_until
from tests.configs import ROOT, TINY
from tests.runs import has_saved
from torchrl_etl.command_line import print_intervals, quote_paths
from torchrl_etl.synergies import load_bundle, save_bundle

SMALL = [override for override in TINY if not override.startswith("env=")]


@pytest.fixture(scope="module")
def hand(tmp_path_factory) -> Path:
    """A smoke run of both stages on a MyoSuite hand, with pictures; its path has a space."""
    folder = tmp_path_factory.mktemp("with a space") / "a run"
    done = process(
        "etl_sac.py",
        *SMALL,
        "env=myoHandPose",
        "pictures=true",
        f"run_dir='{folder}'",
        cwd=folder.parent,
    )
    assert done.returncode == 0, done.stderr
    for word in (
        "variance accounted for",
        "alignment",
        "before",
        "solved",
        str(folder / "pictures"),
    ):
        assert word in done.stdout
    return folder


@pytest.mark.slow
def test_run_folder_is_complete(hand):
    for name in (
        "config.yaml",
        "versions.json",
        "summary.json",
        "synergies/synergies.safetensors",
        "synergies/synergies.json",
        "csv/scalars/learn/eval/return.csv",
        "pictures/learning_curves.png",
        "pictures/synergies.png",
        "pictures/vaf.png",
        "pictures/embedding.png",
    ):
        assert (hand / name).is_file(), name
    assert list((hand / "tensorboard").glob("events*"))
    summary = json.loads((hand / "summary.json").read_text())
    assert summary["learn"]["frames_charged"] == 1216
    assert {"return", "solved", "solved_time"} <= summary["learn"].keys()
    assert "??" not in (hand / "config.yaml").read_text()


@pytest.mark.slow
def test_evaluate_repeats_the_return_of_the_run(hand, capsys):
    assert command("evaluate.py", f"run='{hand}'", "episodes=2") == 0
    result = json.loads((hand / "evaluation.json").read_text())
    summary = json.loads((hand / "summary.json").read_text())
    assert result["return"]["mean"] == pytest.approx(summary["learn"]["return"]["after"])
    assert "95% interval" in capsys.readouterr().out


def test_one_episode_is_printed_without_an_interval(capsys):
    print_intervals({"return": {"mean": 2.0, "low": float("nan"), "high": float("nan")}})
    assert capsys.readouterr().out == "  return       2.000\n"


def test_evaluate_tells_its_numbers_where_it_cannot_write_them(tmp_path):
    (tmp_path / "runs").write_text("a file where the folder should be")
    ended = process("evaluate.py", "zoo=overactuated", "episodes=2", cwd=tmp_path)
    assert ended.returncode == 2 and "return" in ended.stdout
    assert ended.stderr.startswith("Error: ") and "Traceback" not in ended.stderr


@pytest.mark.slow
def test_evaluate_writes_videos_or_asks_for_a_gl_back_end(hand):
    done = process(
        "evaluate.py",
        f"run='{hand}'",
        "episodes=1",
        "video=true",
        "video_episodes=1",
        "video_seconds=0.2",
        "video_size=[64,80]",
        cwd=hand.parent,
    )
    if done.returncode:
        assert "install a GL back end" in done.stderr and "Traceback" not in done.stderr
    else:
        for name in ("episodes.mp4", "episodes.webp"):
            assert (hand / "videos" / name).stat().st_size > 1_000


@pytest.mark.slow
def test_stage_2_learns_another_task_from_a_bundle(hand, tmp_path):
    decoder, info = load_bundle(hand)  # saved again without facts
    bundle = save_bundle(decoder, tmp_path / "own", task=info.task, actuators=info.actuators)
    settings = ("env=myoHandKeyTurn", "stage=learn", f"synergies='{bundle}'")
    assert command("etl_sac.py", *SMALL, *settings, f"run_dir='{tmp_path}/run'") == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["synergies"]["task"] == "myoHandPoseFixed-v0"
    assert summary["learn"]["frames_charged"] == summary["learn"]["frames"]
    assert (tmp_path / "run" / "synergies" / "synergies.json").is_file()  # a copy of the bundle


@pytest.mark.slow
def test_bundle_for_other_muscles_gives_a_one_line_error(hand, tmp_path, capsys):
    settings = ("env=humanoid-stand", f"synergies='{hand}'")
    assert command("etl_sac.py", *SMALL, *settings, f"run_dir='{tmp_path}/run'") == 2
    said = capsys.readouterr().err
    assert said.startswith("Error: ") and said.count("\n") == 1
    assert "with no name in common" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", ["env=Walker2d-v5", "faithful=paper", "learn.decoder.residual=0.2"]
)
def test_both_stages_run_on_a_gymnasium_id_and_with_paper_settings(options, tmp_path):
    assert command("etl_sac.py", *TINY, options, f"run_dir='{tmp_path}/run'") == 0
    assert command("evaluate.py", f"run='{tmp_path}/run'", "episodes=2") == 0


@pytest.mark.parametrize(
    ("recipe", "override", "words"),
    [
        ("etl_sac.py", "method=latice", "nearest: lattice"),
        ("etl_sac.py", "method=pink", ", or add a file for it to ./conf/method."),
        ("etl_sac.py", "method.options.frames=5", "with method=etl there is no setting 'method.o"),
        ("etl_sac.py", "+exploration.std=5", "with exploration=metric there is no setting 'expl"),
        ("etl_sac.py", "enf=myoHandPose", "did you mean env"),
        ("etl_sac.py", "learn.frame=3", "learn.frames"),
        ("etl_sac.py", "env=myoHandPos", "myoHandPose"),
        ("etl_sac.py", "+learn.sac.gama=0.9", "did you mean learn.sac.gamma"),
        ("etl_sac.py", "++runs_dir=a", "did you mean run_dir"),
        ("etl_sac.py", "+new=1", "there is no setting 'new'"),
        ("etl_sac.py", "~learn.sac.gama", "did you mean learn.sac.gamma"),
        ("etl_sac.py", "~learn.frames", "~learn.frames would remove a setting"),
        ("etl_sac.py", "~synergies", "~synergies would remove a setting"),
        ("etl_sac.py", "+log_every=5", "+log_every is a setting that already exists"),
        ("etl_sac.py", "learn.frames=[1", "'learn.frames=[1' is not of the form key=value"),
        ("etl_sac.py", "exploration=null", "choose one of metra, metric"),
        ("etl_sac.py", "learn.anchor=0.1", "is called learn.decoder.distillation_weight now."),
        ("etl_sac.py", "-m", "recipes/sweep.py"),
        ("sweep.py", "--multirun", "recipes/sweep.py"),
        ("bench.py", "seeds=[0]", "recipes/sweep.py"),
        ("evaluate.py", "video_size=[480,641]", "two even whole numbers"),
        ("evaluate.py", "video_size=480", "two even whole numbers"),
        ("evaluate.py", "video_size=[0,0]", "two even whole numbers"),
        ("evaluate.py", "video_size=[a,b]", "two even whole numbers"),
        ("etl_sac.py", "myoHandPose", "not of the form key=value"),
        ("evaluate.py", "run=no (where)", "holds no run"),
        ("etl_sac.py", "resume=[]", "resume is []; pass folders of runs"),
        ("evaluate.py", "episodes=3", "no run is given; pass run=PATH"),
        ("evaluate.py", "run=[a,b]", "run is ['a', 'b']; it must be one path"),
        ("evaluate.py", "episode=3", "did you mean episodes"),
    ],
)
def test_mistyped_argument_is_refused_with_advice(
    recipe, override, words, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert command(recipe, override) != 0
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("recipe", "override", "words"),
    [
        ("etl_sac.py", "env=myoHandPos", "myoHandPose"),
        ("evaluate.py", "run=no (where)", "holds no run"),
        ("sweep.py", "metods=[sac]", "did you mean methods"),
    ],
)
def test_argument_error_prints_no_traceback(recipe, override, words, tmp_path):
    done = process(recipe, override, cwd=tmp_path)
    assert done.returncode != 0
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_gl_back_end_is_chosen_before_mujoco_is_imported(tmp_path):
    code = (
        "import os, sys\n"
        "from torchrl_etl.gl_backend import draw_without_display\n"
        "assert 'mujoco' not in sys.modules\n"
        "draw_without_display()\n"
        "assert 'mujoco' not in sys.modules\n"
        "print(os.environ.get('MUJOCO_GL', 'none works'))\n"
        "import mujoco\n"
        "if 'MUJOCO_GL' in os.environ: mujoco.GLContext(16, 16).make_current()\n"
    )
    environ = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environ |= {"MUJOCO_GL": ""}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environ)
    assert done.returncode == 0, done.stderr
    recipe = (ROOT / "recipes" / "evaluate.py").read_text()
    for importer in ("torchrl.envs", "torchrl_etl.training"):
        assert recipe.index("draw_without_display()") < recipe.index(importer)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere MuJoCo has no such back ends")
@pytest.mark.parametrize(
    ("backend", "cure"),
    [("osmesa", "libosmesa6"), ("egl", "libegl1"), ("bogus", "egl, osmesa or glfw")],
)
def test_unusable_gl_back_end_is_ignored_with_advice(backend, cure):
    code = (
        "import ctypes, os\n"
        "real = ctypes.CDLL\n"
        "def missing(name, *args, **kwargs):\n"
        "    if str(name).startswith(('libEGL', 'libOSMesa')): raise OSError(name)\n"
        "    return real(name, *args, **kwargs)\n"
        "ctypes.CDLL = missing\n"
        "import torchrl_etl\n"
        "ctypes.CDLL = real\n"
        "assert 'MUJOCO_GL' not in os.environ\n"
        "import mujoco\n"
    )
    environ = os.environ | {"MUJOCO_GL": backend}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environ)
    assert done.returncode == 0, done.stderr
    assert f"MUJOCO_GL={backend} is ignored" in done.stderr and cure in done.stderr


def test_tilde_expands_to_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    given = ["run_dir=~/runs", "resume='~/a b'", "seed=~/x"]
    assert quote_paths(given, "run_dir", "resume") == [
        "run_dir='/home/me/runs'",
        "resume='/home/me/a b'",
        "seed=~/x",
    ]


def test_help_lists_the_settings(capsys):
    assert command("etl_sac.py", "--help") == 0
    said = capsys.readouterr().out
    for word in ("stage", "synergies", "faithful", "resume", "num_envs", "kl_weight", "epsilon"):
        assert word in said


def test_help_into_a_closed_pipe_prints_no_error():
    recipe = shlex.join([sys.executable, str(ROOT / "recipes" / "etl_sac.py")])
    done = subprocess.run(f"{recipe} --help | true", shell=True, capture_output=True, text=True)
    assert done.stderr == ""


@pytest.mark.slow
def test_ctrl_c_saves_and_prints_how_to_resume(tmp_path):
    folder = tmp_path / "run"
    arguments = [*TINY, "explore.frames=100000", f"run_dir='{folder}'"]
    running = begun("etl_sac.py", *arguments, cwd=tmp_path)
    wait_until(lambda: has_saved(folder, "explore"), running)
    running.send_signal(signal.SIGINT)
    output, _ = running.communicate(timeout=60)
    assert running.returncode == 130
    assert f"resume={folder}" in output
    assert "Traceback" not in output


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_both_stages_run_on_cuda(tmp_path):
    done = process("etl_sac.py", *TINY, "device=cuda", f"run_dir='{tmp_path}/run'", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
