"""The two stages, the loop around them, checkpoints and evaluation."""

from torchrl_etl.training.bench import Bench, Run
from torchrl_etl.training.config import validate
from torchrl_etl.training.evaluation import Evaluation, evaluate
from torchrl_etl.training.experiment import Experiment
from torchrl_etl.training.explore import ExploreStage
from torchrl_etl.training.learn import LearnStage
from torchrl_etl.training.loop import Interrupted
from torchrl_etl.training.resumed import resumed_config
from torchrl_etl.training.synergy_report import fit_gmvae
from torchrl_etl.training.video import record_episodes

__all__ = [
    "Bench",
    "Evaluation",
    "Experiment",
    "ExploreStage",
    "Interrupted",
    "LearnStage",
    "Run",
    "evaluate",
    "fit_gmvae",
    "record_episodes",
    "resumed_config",
    "validate",
]
