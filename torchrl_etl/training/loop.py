"""The loop of a stage: collect, update, log, evaluate, save; stop cleanly on a signal."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import FrameType
from typing import TYPE_CHECKING, Any

from tensordict import TensorDictBase

from torchrl_etl.collectors import STOP_SIGNALS
from torchrl_etl.extras import extra
from torchrl_etl.training.checkpoints import Checkpoints
from torchrl_etl.training.evaluation import Evaluation
from torchrl_etl.training.run_folder import RunFolder
from torchrl_etl.training.stage import Stage
from torchrl_etl.training.work import Work

if TYPE_CHECKING:
    from tqdm import tqdm

__all__ = ["Interrupted", "StopOnSignal", "run_stage"]


class Interrupted(KeyboardInterrupt):
    """The run was asked to stop and has saved its state."""


class StopOnSignal(AbstractContextManager):
    """Turns the first stop signal into a request to stop at the next safe point.

    Stop signals are Ctrl-C, SIGTERM, SIGUSR1 (which Slurm can send before the time limit) and
    SIGHUP (a closed terminal; ignored under ``nohup``). A second signal ends the process at once.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopOnSignal:
        for number in STOP_SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raise :class:`Interrupted` if a stop was requested."""
        if self.requested:
            raise Interrupted

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            # Restore the default action rather than raise, which could interrupt any code.
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        self.requested = True


def run_stage(
    stage: Stage,
    folder: RunFolder,
    stop: StopOnSignal,
    *,
    evaluate: Callable[[], Evaluation] | None = None,
    evaluate_every: int = 0,
    checkpoint_every: int,
    keep: int = 2,
    log_every: int,
    offset: int = 0,
    show_progress: bool = True,
) -> Work[Evaluation | None]:
    """Run a stage to the end of its budget, resuming from its newest undamaged checkpoint.

    Every checkpoint starts new episodes (see :meth:`Stage.restart_collection`), so a run that was
    killed and resumed gives the same numbers as an uninterrupted one.

    Args:
        stage (Stage): the stage to run.
        folder (RunFolder): folder for metrics and checkpoints.
        stop (StopOnSignal): checked after every batch.

    Keyword Args:
        evaluate (callable, optional): evaluates the current policy.
        evaluate_every, checkpoint_every, log_every (int): intervals in frames of this stage.
        keep (int): checkpoints to keep.
        offset (int): frames used before this stage, added to logged frame counts.
        show_progress (bool): draw a progress bar.

    Returns:
        Evaluation, optional: the evaluation after the last frame, if this call made it.

    Raises:
        Interrupted: after saving, if a stop was requested.
    """
    checkpoints = Checkpoints(folder.checkpoints(stage.name), keep_last=keep)
    resumed = checkpoints.load_newest_whole(stage.checkpoint())
    if not resumed:
        _refuse_lost_checkpoints(stage, folder)
    # A run that was killed before saving has logged rows, too.
    folder.forget_after(stage.name, offset + stage.frames, from_start=not resumed)
    if stage.finished:
        stage.close()  # loading has put the buffer into files, if it is kept there
        return None

    bar = _progress_bar(stage, show_progress)
    last = None
    report = _Report(stage, folder, bar, offset)
    try:
        if not resumed and evaluate is not None:
            report.evaluation(evaluate())
        stage.start_collection()
        yield None  # workers of other seeds start meanwhile
        stage.restart_collection()
        while not stage.finished:
            before = stage.frames
            stage.request()
            yield None  # other seeds request their batches before this one waits
            report.batch(stage.collect(), (yield from stage.learn()))
            while stage.has_due_updates and not stop.requested:
                yield from stage.learn()
            if _passed(before, stage.frames, log_every) or stage.finished:
                report.write()
            if evaluate is not None and (
                _passed(before, stage.frames, evaluate_every) or stage.finished
            ):
                report.evaluation(last := evaluate())
            if _passed(before, stage.frames, checkpoint_every) or stage.finished or stop.requested:
                checkpoints.save(stage.checkpoint(), step=stage.frames)
                folder.remember_saved(stage.name, stage.frames)
                if stop.requested and not stage.finished:
                    raise Interrupted
                if not stage.finished:
                    stage.restart_collection()
                    report.forget_open_window()
    finally:
        bar.close()
        stage.close()
    return last


def _refuse_lost_checkpoints(stage: Stage, folder: RunFolder) -> None:
    """Raise rather than overwrite the logs of a stage whose checkpoints are missing."""
    if stage.name in (saved := folder.saved):
        raise OSError(
            f"{folder.path} was saved at frame {saved[stage.name]} of stage {stage.name!r} but has "
            f"no checkpoint of it; copy checkpoints/{stage.name} back, or start a new run."
        )


def _progress_bar(stage: Stage, show: bool) -> tqdm:
    with extra("recipes"):
        from tqdm import tqdm
    return tqdm(
        total=stage.budget,
        initial=stage.frames,
        desc=stage.name,
        unit="frame",
        disable=not show,
        mininterval=0.5,
    )


class _Report:
    """Logs means over the window since the last row, and updates the progress bar."""

    def __init__(self, stage: Stage, folder: RunFolder, bar: tqdm, offset: int) -> None:
        self.stage, self.folder, self.bar, self.offset = stage, folder, bar, offset
        self.shown: dict[str, str] = {}
        self.clock = time.perf_counter()
        self.forget_open_window()

    def forget_open_window(self) -> None:
        """Start a new window. Checkpoints do, so that a resumed run logs the same means."""
        self.returns: list[float] = []
        self.solved: list[float] = []
        self.losses: list[TensorDictBase] = []
        self.since, self.start = self.stage.frames, time.perf_counter()

    def batch(self, batch: TensorDictBase, losses: TensorDictBase | None) -> None:
        ended = batch["next", "done"].squeeze(-1)
        self.returns += batch["next", "episode_reward"][ended].flatten().tolist()
        if "solved" in batch["next"].keys():
            self.solved.append(batch["next", "solved"].float().mean().item())
        if losses is not None:
            self.losses.append(losses)
        self.bar.update(self.stage.frames - self.bar.n)
        now = time.perf_counter()
        self.stage.progress.seconds += now - self.clock
        self.clock = now

    def write(self) -> None:
        progress = self.stage.progress
        values: dict[str, float] = {"updates": progress.updates, "episodes": progress.episodes}
        if self.returns:
            values["return"] = sum(self.returns) / len(self.returns)
        if self.solved:
            values["solved_steps"] = sum(self.solved) / len(self.solved)
        for key in self.losses[0].keys() if self.losses else ():
            values[key] = sum(loss[key].item() for loss in self.losses) / len(self.losses)
        elapsed = time.perf_counter() - self.start
        values["frames_per_second"] = (self.stage.frames - self.since) / elapsed
        values["wall_seconds"] = self.stage.progress.seconds
        self._log(values)
        if self.returns:
            self._show(**{"return": f"{values['return']:.1f}"})
        self.forget_open_window()

    def evaluation(self, evaluation: Evaluation) -> None:
        means = {name: value.mean for name, value in evaluation.intervals().items()}
        values = {f"eval/{name}": mean for name, mean in means.items()}
        values["eval/wall_seconds"] = self.stage.progress.seconds
        if "solved" in means:
            self._show(solved=f"{means['solved']:.0%}")
        self._show(eval=f"{values['eval/return']:.1f}")
        self._log(values)

    def _log(self, values: dict[str, float]) -> None:
        frame = self.offset + self.stage.frames
        self.folder.log({f"{self.stage.name}/{key}": v for key, v in values.items()}, frame)

    def _show(self, **shown: str) -> None:
        self.shown.update(shown)
        self.bar.set_postfix(self.shown)


def _passed(before: int, after: int, every: int) -> bool:
    """Whether a multiple of ``every`` lies in (before, after]."""
    return every > 0 and before // every < after // every
