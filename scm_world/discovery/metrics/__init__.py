"""How near a found graph comes to the true one, and what it is good for."""

from scm_world.discovery.metrics.comparison import Scores, evaluate, matrices
from scm_world.discovery.metrics.distances import aid, shd, shd_of_classes, sid, sid_bounds
from scm_world.discovery.metrics.prediction import Prediction, effect_rmse, hold_out
from scm_world.discovery.metrics.ranking import auprc, auroc

__all__ = [
    "Prediction",
    "Scores",
    "aid",
    "auprc",
    "auroc",
    "effect_rmse",
    "evaluate",
    "hold_out",
    "matrices",
    "shd",
    "shd_of_classes",
    "sid",
    "sid_bounds",
]
