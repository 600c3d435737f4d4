"""Identification of parameters from recordings: fits, explanations of deviations, experiments."""

from scm_world.fit.design import Experiment
from scm_world.fit.deviation import Deviation, explain
from scm_world.fit.diagnosis import Diagnosis
from scm_world.fit.fitting import fit
from scm_world.fit.prediction import Prediction
from scm_world.fit.problem import LeastSquares, Minimum, Search
from scm_world.fit.result import Fit

__all__ = [
    "Deviation",
    "Diagnosis",
    "Experiment",
    "Fit",
    "LeastSquares",
    "Minimum",
    "Prediction",
    "Search",
    "explain",
    "fit",
]
