"""Analysis of runs: synergy diagnostics, plots, and statistics of evaluations."""

from torchrl_etl.analysis.cross_validation import (
    CrossValidation,
    cross_validate,
    enough_synergies,
    held_out_rows,
)
from torchrl_etl.analysis.diagnostics import (
    control_authority,
    direction_alignment,
    synergy_effects,
    synergy_warnings,
)
from torchrl_etl.analysis.joint_effects import JointEffects, joint_effects
from torchrl_etl.analysis.pictures import embedding, learning_curves, synergy_heatmap, vaf_curve
from torchrl_etl.analysis.statistics import Interval, interval, success_interval
from torchrl_etl.analysis.synergy_report import describe_synergies, draw_synergies
from torchrl_etl.analysis.variance import nmf_vaf, pca_vaf, variance_accounted_for

__all__ = [
    "CrossValidation",
    "Interval",
    "JointEffects",
    "control_authority",
    "cross_validate",
    "describe_synergies",
    "direction_alignment",
    "draw_synergies",
    "embedding",
    "enough_synergies",
    "held_out_rows",
    "interval",
    "joint_effects",
    "learning_curves",
    "nmf_vaf",
    "pca_vaf",
    "success_interval",
    "synergy_effects",
    "synergy_heatmap",
    "synergy_warnings",
    "vaf_curve",
    "variance_accounted_for",
]
