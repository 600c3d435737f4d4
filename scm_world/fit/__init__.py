"""Identification of parameters from recordings: fits, explanations of deviations, experiments."""

from scm_world.fit.design import Experiment
from scm_world.fit.deviation import Deviation, explain
from scm_world.fit.fitting import Fit, fit

__all__ = ["Deviation", "Experiment", "Fit", "explain", "fit"]
