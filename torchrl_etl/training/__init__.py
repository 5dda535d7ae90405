"""Training: a stage and its loop, checkpoints, evaluation, and queues of runs."""

from typing import TYPE_CHECKING, Any

from torchrl_etl.training.config import check_device, validate
from torchrl_etl.training.context import Context
from torchrl_etl.training.evaluation import Evaluation, evaluate, evaluate_task
from torchrl_etl.training.interleaved import run_interleaved
from torchrl_etl.training.loop import Interrupted
from torchrl_etl.training.stage import Stage
from torchrl_etl.training.sweep import Run, Sweep
from torchrl_etl.training.video import EpisodeRecorder, check_video_size
from torchrl_etl.training.work import run_alone

if TYPE_CHECKING:
    from torchrl_etl.training.resumed import resumed_config

__all__ = [
    "Context",
    "EpisodeRecorder",
    "Evaluation",
    "Interrupted",
    "Run",
    "Stage",
    "Sweep",
    "check_device",
    "check_video_size",
    "evaluate",
    "evaluate_task",
    "resumed_config",
    "run_alone",
    "run_interleaved",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name == "resumed_config":  # needs Hydra, which running a stage does not
        from torchrl_etl.training.resumed import resumed_config

        return resumed_config
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
